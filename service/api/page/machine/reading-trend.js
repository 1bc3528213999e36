import { html, lay } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { monitor, pathOf } from "../monitor/monitor.js";
import { GAP, shortest, stretch, Z95 } from "../monitor/figures.js";
import "../elements/line-chart.js";

const [POINTS, EVENTS] = [240, 200];

/** @import { AlarmEventData as AlarmEvent, ReadingBucket as Bucket } from "../monitor/records.d.ts" */
/** @typedef {{at: number, kind: "alert" | "danger", text: string, below?: boolean}} Limit */
/** A reading shown over time; limits within `near` are always visible. @typedef {{name: string, alarm: string, title: string, unit: string, scale: number, limits: Limit[], near: number, zones?: import("../elements/line-chart.js").Zone[], said?: string[], zero: boolean, changed: {text: string, since_ns: number, between_ns?: [number, number] | null}[]}} Trended */

/** Readings of a machine over time, a chart each, with interval bands, limits and the times of alarms. */
export class ReadingTrend extends MachineElement {
  refreshS = 15;
  quantity = "";
  title = "";
  /** What the band shows, and remarks on the limits. */
  note = "the band shows the 95 % intervals.";
  /** @type {number | null} */
  #oldest = null;
  /** @type {Map<string, any>} */
  #charts = new Map();
  #figures = html("div", { class: "charts" });
  message = html("p", { class: "message" });
  #when = html("p", { class: "note" });
  /** The data loaded last. @type {{shown: Trended[], buckets: Bucket[], events: AlarmEvent[]}} */
  #read = { shown: [], buckets: [], events: [] };
  /** A marked moment, ns. @type {number | null} */
  #moment = null;

  connectedCallback() {
    super.connectedCallback();
    this.replaceChildren(html("h2", {}, this.title), this.#when, this.message, this.#figures);
    this.follow("alarm", ({ detail }) => `${detail.site}/${detail.machine}` === this.place && this.load());
  }

  /**
   * Time span: the attribute `hours`, or everything without it; not longer than the readings, which would otherwise all fall into one bucket.
   * @param {Trended[]} shown
   */
  async #since(shown) {
    const [hours, end] = [Number(this.getAttribute("hours")), this.health?.report?.end_ns];
    if (this.#oldest === null) {
      const asked = new URLSearchParams({ quantity: this.quantity, points: "1", name: shown[0].name });
      const [first] = (await monitor.ask(`${pathOf(this.place)}/readings?${asked}`)).buckets;
      this.#oldest = first?.start_ns ?? null;
    }
    return Math.max(this.#oldest ?? 0, hours && end ? end - hours * 3600e9 : 0);
  }

  /** The readings to be shown. @returns {Promise<Trended[]>} */
  async trended() {
    return [];
  }

  async ask() {
    const shown = await this.trended();
    this.hidden = !shown.length;
    if (!shown.length) return;
    this.#read = { shown, ...(await this.readings(shown)) };
    this.#show();
  }

  /** Mark a moment, ns. @param {number} moment */
  mark(moment) {
    this.#moment = moment;
    this.#show();
  }

  /** Readings and events from the history. @param {Trended[]} shown @returns {Promise<{buckets: Bucket[], events: AlarmEvent[]}>} */
  async readings(shown) {
    const since = String(await this.#since(shown));
    const asked = new URLSearchParams({ quantity: this.quantity, points: String(POINTS), since_ns: since });
    for (const one of shown.slice(0, 64)) asked.append("name", one.name);
    const [readings, events] = await Promise.all([
      monitor.ask(`${pathOf(this.place)}/readings?${asked}`),
      monitor.ask(`${pathOf(this.place)}/alarms/events?limit=${EVENTS}&since_ns=${since}`),
    ]);
    return { buckets: readings.buckets, events: events.events.map((/** @type {{data: AlarmEvent}} */ one) => one.data) };
  }

  #show() {
    const { shown, buckets, events } = this.#read;
    for (const one of shown) this.#draw(one, buckets.filter((bucket) => bucket.name === one.name), events);
    const ends = buckets.map((bucket) => bucket.start_ns + bucket.length_ns);
    if (ends.length) this.#when.textContent = `${stretch(Math.min(...buckets.map((bucket) => bucket.start_ns)), Math.min(Math.max(...ends), this.health?.report?.end_ns ?? Infinity))}: a point for each window, or for the mean of several; ${this.note}`;
    this.message.textContent = buckets.length ? "" : "Nothing has been read yet.";
  }

  /** @param {Trended} one @param {Bucket[]} buckets @param {AlarmEvent[]} events */
  #draw(one, buckets, events) {
    let chart = this.#charts.get(one.name);
    if (!chart) {
      chart = html("line-chart", { role: "img", "aria-label": `${one.title} over time` });
      this.#charts.set(one.name, chart);
      this.#figures.append(html("figure", {}, html("figcaption", {}), chart));
    }
    const caption = /** @type {HTMLElement} */ (chart.previousElementSibling);
    lay(caption, one.title, ...(one.said ?? []).map((text) => html("small", {}, ` ${text}`)));
    if (!buckets.length) return;
    /** @type {number[]} */
    const x = [];
    /** @type {(number | null)[][]} */
    const [mean, low, high] = [[], [], []];
    /** @type {{from: number, to: number, text: string}[]} */
    const gaps = [];
    const step = shortest(buckets.map((each) => each.start_ns));
    let before = buckets[0].start_ns;
    for (const bucket of buckets) {
      if (bucket.start_ns - before > GAP * step) {
        x.push((before + step) / 1e9);
        gaps.push({ from: (before + step) / 1e9, to: bucket.start_ns / 1e9, text: "no data" });
        for (const line of [mean, low, high]) line.push(null);
      }
      before = bucket.start_ns;
      const error = Z95 * (bucket.mean_standard_error ?? 0);
      x.push(bucket.start_ns / 1e9);
      mean.push(one.scale * bucket.mean);
      low.push(one.scale * Math.min(bucket.minimum, bucket.mean - error));
      high.push(one.scale * Math.max(bucket.maximum, bucket.mean + error));
    }
    const reached = Math.max(...[...low, ...high].map((each) => Math.abs(each ?? 0)));
    const next = Math.min(...one.limits.map(({ at }) => Math.abs(at)).filter((at) => at > reached));
    const near = one.limits.map(({ at }) => at).filter((at) => Math.abs(at) < 2.5 * reached || Math.abs(at) <= one.near || (Math.abs(at) === next && next < 8 * reached));
    const changes = one.changed.filter((each) => each.since_ns / 1e9 >= x[0]);
    const marks = [
      ...(this.#moment === null ? [] : [{ at: this.#moment / 1e9, axis: /** @type {"x"} */ ("x"), colour: "estimated" }]),
      ...changes.map((each) => ({ at: each.since_ns / 1e9, axis: /** @type {"x"} */ ("x"), colour: "ink", text: each.text })),
      ...one.limits.map(({ at, kind, text, below }) => ({ at, below, axis: /** @type {"y"} */ ("y"), colour: `${kind}-line`, text, ...(kind === "alert" ? { dash: [6, 4] } : {}) })),
      ...events
        .filter((event) => event.name === one.alarm && ["raised", "escalated", "cleared"].includes(event.kind))
        .map((event) => ({ at: event.time_ns / 1e9, axis: /** @type {"x"} */ ("x"), colour: event.kind === "cleared" ? "ink-2" : `${event.severity}-line`, text: event.kind, dash: [2, 3] })),
    ];
    chart.draw({
      x,
      lines: [{ label: "mean", values: mean, width: 2 }, { label: "low", values: low, hidden: true }, { label: "high", values: high, hidden: true }],
      band: [2, 1],
      marks,
      time: true,
      shaded: [...gaps, ...changes.flatMap(({ between_ns: moment }) => (moment ? [{ from: moment[0] / 1e9, to: moment[1] / 1e9 }] : []))],
      include: [...near, ...(one.zero ? [0] : [])],
      zones: one.zones,
      unit: one.unit,
      height: one.zones?.length ? 210 : 170,
    });
  }
}
