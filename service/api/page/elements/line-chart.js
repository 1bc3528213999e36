import { html } from "./markup.js";
import { clock, local, shownIn, ticks } from "../monitor/figures.js";

/** @typedef {{label: string, values: (number | null)[], colour?: string, dash?: number[], hidden?: boolean, width?: number, dots?: boolean}} Line */
/** A marked position with its label, above the line or `below`. @typedef {{at: number, axis: "x" | "y", colour: string, text?: string, dash?: number[], below?: boolean}} Mark */
/** A range of values, such as a zone of a standard; `edge` if it begins with a line. @typedef {{from: number, to: number, text: string, colour?: string, edge?: boolean}} Zone */
/** @typedef {{x: number[], lines: Line[], band?: [number, number], marks: Mark[], time: boolean, log?: boolean, include?: number[], unit: string, cut?: [number, number, number], xUnit?: string, shaded?: {from: number, to: number, text?: string}[], zones?: Zone[], height: number}} Drawing */

/** Least pixels between ticks of time: for minutes, and for seconds, whose labels are longer. */
const SPACE = [56, 84];

/** @type {Promise<any> | undefined} */
let library;

/** The chart library, loaded by the first view that draws a chart. @returns {Promise<any>} */
function charts() {
  library ??= new Promise((resolve, reject) => {
    const at = (/** @type {string} */ name) => new URL(`../${name}`, import.meta.url).href;
    document.head.append(html("link", { rel: "stylesheet", href: at("uPlot.min.css") }));
    const script = html("script", { src: at("uPlot.iife.js"), load: () => resolve(/** @type {any} */ (window).uPlot), error: () => reject(new Error("charts cannot be loaded; reload the page")) });
    document.head.append(script);
  });
  return library;
}

/** Tick positions, with those outside the axis replaced by null. @param {any} plot @param {number[]} at */
const within = (plot, at) => at.map((each) => (each >= plot.scales.x.min && each <= plot.scales.x.max ? each : null));

/** Lines over time or frequency, with bands, limits and marks; colours are names of properties of the style sheet. */
class LineChart extends HTMLElement {
  /** @type {any} */
  #plot = null;
  /** @type {Drawing | null} */
  #drawing = null;
  /** @type {Drawing | null} as given, before conversion to the units shown */
  #given = null;
  #shape = "";
  /** Positions of the names of zones. @type {{from: number, to: number, at: number}[]} */
  #names = [];
  #sized = new ResizeObserver(() => this.#plot?.setSize(this.#size()));
  #dark = matchMedia("(prefers-color-scheme: dark)");
  #again = () => {
    this.#shape = "";
    if (this.#given) this.draw(this.#given);
  };

  #print = () => this.#plot?.setSize(this.#size(true)); // the resize observer would be too late for print
  #printed = () => this.#plot?.setSize(this.#size(false));

  connectedCallback() {
    this.#sized.observe(this);
    addEventListener("beforeprint", this.#print);
    addEventListener("afterprint", this.#printed);
    this.#dark.addEventListener("change", this.#again);
  }

  disconnectedCallback() {
    this.#sized.disconnect();
    removeEventListener("beforeprint", this.#print);
    removeEventListener("afterprint", this.#printed);
    this.#dark.removeEventListener("change", this.#again);
    this.#plot?.destroy();
    this.#plot = null;
    this.#shape = "";
  }

  /** @param {Drawing} given */
  async draw(given) {
    this.#given = given;
    const [factor, unit] = shownIn(given.unit);
    const scaled = (/** @type {number | null} */ value) => (value === null ? null : factor * value);
    const drawing = factor === 1 ? given : {
      ...given,
      unit,
      lines: given.lines.map((line) => ({ ...line, values: line.values.map(scaled) })),
      marks: given.marks.map((mark) => (mark.axis === "y" ? { ...mark, at: factor * mark.at } : mark)),
      include: given.include?.map((each) => factor * each),
      zones: given.zones?.map((zone) => ({ ...zone, from: factor * zone.from, to: factor * zone.to })),
    };
    this.#drawing = drawing;
    const uPlot = await charts();
    if (!this.isConnected) return;
    const data = [drawing.x, ...drawing.lines.map((line) => line.values)];
    const shape = JSON.stringify([drawing.lines.map((line) => line.label), drawing.unit, local()]);
    if (this.#plot && shape === this.#shape) return this.#plot.setData(data);
    this.#plot?.destroy();
    this.#shape = shape;
    this.#plot = new uPlot(this.#options(uPlot, drawing), data, this);
  }

  /** Size of the chart on the page or, for print, from the style sheet. */
  #size(paper = matchMedia("print").matches) {
    const [width, height] = paper ? getComputedStyle(this).getPropertyValue("--on-paper").split(" ").filter(Boolean).map(Number) : [];
    return width && height ? { width, height } : { width: Math.max(this.clientWidth, 200), height: this.#drawing?.height ?? 160 };
  }

  /** @param {string} name */
  #colour(name) {
    return getComputedStyle(this).getPropertyValue(`--${name}`).trim();
  }

  /** @param {any} uPlot @param {Drawing} drawing */
  #options(uPlot, drawing) {
    const [ink, grid] = [this.#colour("ink-2"), this.#colour("line")];
    const axis = { stroke: ink, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 }, font: "12px system-ui, sans-serif", labelFont: "12px system-ui, sans-serif" };
    const lines = drawing.lines.map((line) => ({
      label: line.label,
      stroke: line.hidden ? "transparent" : this.#colour(line.colour ?? "trace"),
      width: line.hidden ? 0 : (line.width ?? 1.5),
      dash: line.dash,
      points: { show: !line.hidden && (line.dots || drawing.x.length < 3), size: 4 },
      ...(line.dots ? { paths: () => null } : {}),
      value: (/** @type {any} */ _, /** @type {number | null} */ value) => (value === null ? "–" : Number(value.toPrecision(3)).toString().replace("-", "−")),
    }));
    return {
      ...this.#size(),
      series: [{ label: drawing.time ? "time" : drawing.xUnit, value: (/** @type {any} */ _, /** @type {number | null} */ value) => (value === null ? "–" : drawing.time ? clock(value * 1e9) : value.toFixed(1)) }, ...lines],
      bands: drawing.band ? [{ series: drawing.band.map((at) => at + 1), fill: this.#colour("band") }] : [],
      scales: { x: { time: drawing.time }, y: drawing.log ? { distr: 3 } : drawing.cut ? { dir: -1, range: drawing.cut.slice(0, 2) } : { range: (/** @type {any} */ _, /** @type {number} */ low, /** @type {number} */ high) => this.#range(low, high) } },
      axes: [drawing.time ? { ...axis, space: (/** @type {any} */ _, /** @type {number} */ __, /** @type {number} */ from, /** @type {number} */ to, /** @type {number} */ wide) => (((to - from) * SPACE[0]) / wide < 60 ? SPACE[1] : SPACE[0]), filter: within, values: (/** @type {any} */ _, /** @type {(number | null)[]} */ at, /** @type {any} */ __, /** @type {any} */ ___, /** @type {number} */ step) => ticks(at, step) } : { ...axis, size: 34, label: drawing.xUnit, labelSize: 16 }, { ...axis, size: 56, space: 24, label: drawing.unit, labelSize: 16, ...(drawing.cut ? { incrs: [drawing.cut[2]] } : {}), ...(drawing.log ? { values: (/** @type {any} */ _, /** @type {(number | null)[]} */ at) => at.map((each) => (each === null ? "" : each < 1e-3 ? each.toExponential(0).replace("-", "−") : String(each))) } : {}) }],
      tzDate: (/** @type {number} */ seconds) => (local() ? new Date(seconds * 1e3) : uPlot.tzDate(new Date(seconds * 1e3), "Etc/UTC")),
      cursor: { drag: { x: true, y: false } },
      hooks: { drawAxes: [(/** @type {any} */ plot) => this.#shade(plot)], draw: [(/** @type {any} */ plot) => this.#mark(plot)], setLegend: [(/** @type {any} */ plot) => this.#rest(plot)] },
    };
  }

  /** Range of the vertical axis: all values, and the limits that must be visible. @param {number} low @param {number} high */
  #range(low, high) {
    const seen = [...(this.#drawing?.include ?? []), low, high].filter((each) => Number.isFinite(each));
    const [bottom, top] = [Math.min(...seen), Math.max(...seen)];
    const rim = 0.14 * (top - bottom || Math.abs(top) || 1);
    return [bottom === 0 ? 0 : bottom - rim, top + rim];
  }

  /** Without a pointer the legend shows the newest values of a trend, and no values in other charts. @param {any} plot */
  #rest(plot) {
    const away = plot.cursor.left < 0;
    const still = away && !this.#drawing?.time;
    plot.root.classList.toggle("away", still);
    plot.root.querySelectorAll(".u-series").forEach((/** @type {Element} */ row, /** @type {number} */ at) => row.classList.toggle("bare", still && (!at || !!this.#drawing?.lines[at - 1]?.hidden)));
    if (away && this.#drawing?.time) plot.setLegend({ idx: Math.max(0, this.#drawing.lines[0].values.findLastIndex((each) => each !== null)) }, false);
  }

  /** @param {any} plot */
  #shade(plot) {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textAlign = "left";
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    this.#names = [];
    for (const { from, to, text, colour, edge } of this.#drawing?.zones ?? []) {
      const { min, max } = plot.scales.y;
      const [low, high] = [Math.max(from, min), Math.min(to, max)];
      if (low >= high) continue;
      const [top, bottom] = [high, low].map((each) => plot.valToPos(each, "y", true));
      ctx.fillStyle = colour ? this.#colour(colour) : "transparent";
      ctx.fillRect(bbox.left, top, bbox.width, bottom - top);
      ctx.fillStyle = this.#colour("ink-2");
      if (edge && low === from) ctx.fillRect(bbox.left, bottom, bbox.width, devicePixelRatio);
      ctx.textAlign = "right";
      if (bottom - top > 13 * devicePixelRatio) {
        const [right, at] = [bbox.left + bbox.width - 4 * devicePixelRatio, top + 12 * devicePixelRatio];
        ctx.fillText(text, right, at);
        this.#names.push({ from: right - ctx.measureText(text).width, to: right, at });
      }
      ctx.textAlign = "left";
    }
    for (const { from, to, text } of this.#drawing?.shaded ?? []) {
      const [left, right] = [from, to].map((each) => plot.valToPos(each, "x", true));
      ctx.fillStyle = this.#colour("shade");
      ctx.fillRect(left, bbox.top, right - left, bbox.height);
      ctx.fillStyle = this.#colour("ink-2");
      if (text && ctx.measureText(text).width < right - left) ctx.fillText(text, left + 3 * devicePixelRatio, bbox.top + bbox.height - 5 * devicePixelRatio);
    }
    ctx.restore();
  }

  /** Draw lines of limits and moments first and their labels last, so that labels stay readable on other lines. @param {any} plot */
  #mark(plot) {
    const { ctx, bbox } = plot;
    const [gap, right] = [3 * devicePixelRatio, bbox.left + bbox.width];
    const marks = (this.#drawing?.marks ?? []).map((mark) => ({ ...mark, place: plot.valToPos(mark.at, mark.axis, true), upright: mark.axis === "x" }));
    ctx.save();
    ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
    ctx.textAlign = "left";
    ctx.lineWidth = 1.5 * devicePixelRatio;
    ctx.beginPath();
    ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
    ctx.clip();
    for (const { place, upright, colour, dash } of marks) {
      ctx.strokeStyle = this.#colour(colour);
      ctx.setLineDash((dash ?? []).map((each) => each * devicePixelRatio));
      ctx.beginPath();
      ctx.moveTo(upright ? place : bbox.left, upright ? bbox.top : place);
      ctx.lineTo(upright ? place : right, upright ? bbox.top + bbox.height : place);
      ctx.stroke();
    }
    ctx.setLineDash([]);
    ctx.lineWidth = gap;
    ctx.strokeStyle = this.#colour("surface");
    const taken = [...this.#names];
    const free = (/** @type {number[]} */ [x, y], /** @type {number} */ wide) => x >= bbox.left && x + wide <= right && taken.every(({ from, to, at }) => x > to || x + wide < from || Math.abs(y - at) >= 4 * gap);
    // Limits first: their labels are at the left, side by side if the limits are close.
    for (const { text, place, upright, colour, below } of marks.sort((one, other) => Number(one.upright) - Number(other.upright))) {
      if (!text) continue;
      const wide = ctx.measureText(text).width;
      const rows = upright ? [1, 2, 3, 4, 5, 6].map((row) => bbox.top + 4 * gap * row) : [place + (below && place + 5 * gap < bbox.top + bbox.height ? 4 : -1.6) * gap];
      const from = upright ? [place + gap, place - gap - wide] : [bbox.left + gap, ...taken.map(({ to }) => to + 3 * gap)];
      const places = rows.flatMap((y) => from.map((x) => [x, y]));
      const found = places.find((each) => free(each, wide)) ?? (upright ? places[0] : null);
      if (!found) continue; // limits are also described beside the chart
      const [x, y] = found;
      taken.push({ from: x, to: x + wide, at: y });
      ctx.fillStyle = this.#colour(colour);
      ctx.strokeText(text, x, y);
      ctx.fillText(text, x, y);
    }
    ctx.restore();
  }
}

customElements.define("line-chart", LineChart);
