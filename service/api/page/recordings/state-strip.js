import { clock, lasting } from "../monitor/figures.js";
import { html, lay, svg, table } from "../elements/markup.js";
import { ABNORMAL, STATES } from "../monitor/states.js";
import { runs } from "./stretches.js";
import "../elements/state-mark.js";

const [WIDTH, HEIGHT, OPEN] = [1000, 26, 12];

/** @import { Report } from "../monitor/records.d.ts" */

/** The state of a machine over time, as a strip and in words. */
class StateStrip extends HTMLElement {
  #line = svg("line", { y1: 0, y2: HEIGHT, class: "now" });
  /** @type {[number, number]} */
  #span = [0, 1];

  /** @param {Report[]} reports @param {(at: number) => void} go */
  show(reports, go) {
    const found = runs(reports);
    this.#span = [found[0].from, found[found.length - 1].to];
    const bars = found.map((one) => svg("rect", { class: ABNORMAL.has(one.state) ? one.state : "calm", x: this.#x(one.from), y: ABNORMAL.has(one.state) ? 2 : 8, width: Math.max(2, this.#x(one.to) - this.#x(one.from) - 1), height: ABNORMAL.has(one.state) ? 22 : 10 }, svg("title", {}, `${STATES[one.state] ?? one.state}, from ${clock(one.from)}`)));
    const rows = found.map((one) => ({
      cells: [
        html("time", { class: "number" }, clock(one.from)),
        html("state-mark", { state: one.state }),
        html("span", { class: "number" }, lasting((one.to - one.from) / 1e9)),
        html("div", { class: "actions" }, html("button", { type: "button", "aria-label": `Go to ${STATES[one.state] ?? one.state} from ${clock(one.from)}`, click: () => go(one.at) }, "Go there")),
      ],
    }));
    lay(
      this,
      html("h2", {}, "State over time"),
      svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", role: "img", "aria-label": found.map((one) => `${STATES[one.state] ?? one.state} from ${clock(one.from)}`).join(", ") }, ...bars, this.#line),
      html("p", { class: "ends note" }, html("span", {}, clock(this.#span[0])), html("span", {}, clock(this.#span[1]))),
      html("details", { open: found.length <= OPEN }, html("summary", {}, `${found.length} stretches`), table(["from", "state", "for", "window"], rows, "")),
    );
  }

  /** Mark the position of the scrubber, ns. @param {number} moment */
  mark(moment) {
    for (const end of ["x1", "x2"]) this.#line.setAttribute(end, String(this.#x(moment)));
  }

  /** @param {number} ns */
  #x(ns) {
    return (WIDTH * (ns - this.#span[0])) / (this.#span[1] - this.#span[0] || 1);
  }
}

customElements.define("state-strip", StateStrip);
