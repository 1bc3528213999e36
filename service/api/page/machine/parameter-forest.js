import { percent, stretch, Z95 } from "../monitor/figures.js";
import { html, lay, svg } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { parameterReadings } from "./parameter-readings.js";
import { roundUp } from "../plots/plane.js";

const [WIDTH, LEFT, ROW, TOP] = [360, 48, 46, 6];
/** Readings farther away are written at the edge as numbers, because the others would be too close to distinguish. */
const FARTHEST = 0.6;
const SHAPES = ["decides", "second", "third"];

/** Marker of a diagnostician; each has its own shape. @param {number} who @param {number} x @param {number} y */
function mark(who, x, y) {
  if (who === 0) return svg("circle", { class: SHAPES[0], cx: x, cy: y, r: 4 });
  if (who === 1) return svg("rect", { class: SHAPES[1], x: x - 3.5, y: y - 3.5, width: 7, height: 7 });
  return svg("path", { class: SHAPES[2], d: `M${x} ${y - 4.5} l4.5 8 h-9Z` });
}

/** Readings of each parameter by each diagnostician, with the limits and the range that is not detectable. */
class ParameterForest extends MachineElement {
  needsFile = true;

  show() {
    const [report, readings] = [this.health?.report, parameterReadings(this.health)];
    this.hidden = !this.file || !report || !readings.some((one) => one.read);
    if (this.hidden || !this.file || !report) return;
    const { limits, parameters } = this.file.alarms;
    const who = [report.parameters[0].by, ...report.opinions.map((one) => one.by)];
    const rows = readings.map((one) => ({
      name: one.stated.name,
      seen: one.seen,
      severity: one.severity,
      limit: { ...limits, ...parameters[one.stated.name] },
      read: [one.read ? one.parameter : null, ...report.opinions.map((opinion) => opinion.parameters.find((each) => each.name === one.stated.name) ?? null)].map((each) =>
        each && each.relative_change !== null && each.standard_error !== null ? [each.relative_change - Z95 * each.standard_error, each.relative_change, each.relative_change + Z95 * each.standard_error] : null,
      ),
    }));
    const reach = Math.max(...rows.flatMap((row) => [row.limit.raise_above, ...row.read.flatMap((each) => (each ? [Math.abs(each[0]), Math.abs(each[2])] : []))]));
    const end = Math.min(1.2 * reach, Math.max(FARTHEST, 1.2 * Math.max(...rows.map((row) => row.limit.danger_above))));
    const x = (/** @type {number} */ change) => LEFT + ((Math.max(-end, Math.min(end, change)) + end) / (2 * end)) * (WIDTH - LEFT - 22);
    const bottom = TOP + rows.length * ROW;
    const step = roundUp(end / 4);
    const ticks = [-3, -2, -1, 0, 1, 2, 3].map((each) => each * step).filter((each) => Math.abs(each) <= end);
    lay(
      this,
      html(
        "figure",
        {},
        html("figcaption", {}, "Readings of each diagnostician", html("small", {}, ` changes with 95 % intervals, ${stretch(report.start_ns, report.end_ns)}`)),
        svg(
          "svg",
          { viewBox: `0 0 ${WIDTH} ${bottom + 22}`, role: "img", "aria-label": "change of each parameter as read by each diagnostician; the table has the numbers" },
          ...ticks.map((each) => svg("text", { x: x(each), y: bottom + 16, "text-anchor": "middle", class: "least" }, percent(each).replace(".0", ""))),
          ...ticks.map((each) => svg("line", { class: each ? "grid" : "zero", x1: x(each), x2: x(each), y1: TOP, y2: bottom })),
          ...rows.flatMap((row, at) => this.#row(row, TOP + at * ROW, x, end)),
        ),
        html(
          "p",
          { class: "keys" },
          ...who.map((name, at) => html("span", { class: "key shape" }, svg("svg", { viewBox: "0 0 12 12", "aria-hidden": "true" }, mark(at, 6, 6)), at ? name : `${name}, which decides`)),
          html("span", { class: "key unseen" }, "too small to be detected"),
          html("span", { class: "key alert" }, "alert limit"),
          html("span", { class: "key danger" }, "danger limit"),
        ),
      ),
    );
  }

  /** @param {{name: string, seen: {loss: number, gain: number} | undefined, severity: string, limit: {raise_above: number, danger_above: number}, read: (number[] | null)[]}} row @param {number} y @param {(change: number) => number} x @param {number} end */
  #row({ name, seen, severity, limit, read }, y, x, end) {
    const limits = /** @type {[string, number][]} */ ([["alert", limit.raise_above], ["danger", limit.danger_above]]).filter(([, at]) => at <= end);
    return [
      svg("text", { x: 2, y: y + ROW / 2 + 4, class: `name ${severity}` }, name),
      seen ? svg("rect", { class: "unseen", x: x(seen.loss), y: y + 3, width: x(seen.gain) - x(seen.loss), height: ROW - 6 }) : null,
      ...limits.flatMap(([kind, at]) => [-at, at].map((each) => svg("line", { class: kind, x1: x(each), x2: x(each), y1: y + 3, y2: y + ROW - 3 }))),
      ...read.flatMap((each, who) => {
        const down = y + ROW / 2 + 12 * (who - (read.length - 1) / 2);
        if (each && Math.abs(each[1]) > end) {
          const up = each[1] > 0;
          return [svg("text", { x: x(each[1]), y: down + 4, "text-anchor": up ? "end" : "start", class: "least" }, up ? `${percent(each[1])} →` : `← ${percent(each[1])}`)];
        }
        return each ? [svg("line", { class: SHAPES[Math.min(who, 2)], x1: x(each[0]), x2: x(each[2]), y1: down, y2: down }), mark(who, x(each[1]), down)] : [];
      }),
    ];
  }
}

customElements.define("parameter-forest", ParameterForest);
