import { figure, printed, stretch, within, Z95 } from "../monitor/figures.js";
import { html, table } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { choiceOf, offered } from "./sample-plot.js";
import "../elements/line-chart.js";

/** @import { CorrelationPair as Pair, CorrelationSnapshot as Correlations } from "../monitor/records.d.ts" */

/** @param {Pair} pair */
export const pairName = ({ first, second }) => (first === second ? `${first} with itself` : `${first} and ${second}`);

/** Measured correlation function with its 95 % interval; the second and third line are the edges of a band. @param {Pair} pair @param {import("../elements/line-chart.js").Line} line @returns {import("../elements/line-chart.js").Line[]} */
export function measuredLines(pair, line) {
  const errors = pair.standard_error.map((one) => Z95 * (one ?? 0));
  const edge = (/** @type {number} */ sign) => pair.measured.map((one, at) => (one === null ? null : one + sign * errors[at]));
  return [line, { label: "low", values: edge(-1), hidden: true }, { label: "high", values: edge(1), hidden: true }];
}

/** Correlation functions of a window beside theory, and the residuals of the equations between them. */
class CorrelationPlot extends MachineElement {
  refreshS = 15;
  #choice = choiceOf("Pair of channels", () => this.#draw());
  /** @type {Correlations | null} */
  #found = null;
  message = html("p", { class: "note", role: "status" });
  #chart = /** @type {any} */ (html("line-chart", { role: "img", "aria-label": "correlation function" }));
  #residuals = html("div");

  connectedCallback() {
    super.connectedCallback();
    this.replaceChildren(html("div", { class: "tools" }, this.#choice), this.message, html("figure", {}, this.#chart), this.#residuals);
  }

  async ask() {
    this.#found = await this.askFor("correlations");
    this.#draw();
  }

  #draw() {
    const found = this.#found;
    if (!found) return;
    if (this.#choice.options.length !== found.pairs.length) offered(this.#choice, found.pairs.map((one, at) => [String(at), pairName(one)]));
    const pair = found.pairs[Number(this.#choice.value)];
    this.#chart.parentElement.hidden = this.#choice.hidden = !pair;
    const theory = [...new Set([found.theory.nominal_reason || found.theory.estimated_reason, found.reason])].filter(Boolean);
    if (!pair || !found.start_ns || !found.end_ns) {
      this.message.textContent = [this.windowText(found), ...theory].filter(Boolean).join("; ");
      return;
    }
    const apart = [pair.nominal_z !== null && `nominal ${figure(pair.nominal_z)}`, pair.estimated_z !== null && `estimated ${figure(pair.estimated_z)}`].filter(Boolean);
    this.message.textContent = [`${this.windowText(found) || `Window ${stretch(found.start_ns, found.end_ns)}`}, without mean${found.speed_rad_s === null ? "" : " and 1×"}`, apart.length && `distance from theory in standard errors (rms): ${apart.join(", ")}`, ...theory].filter(Boolean).join("; ");
    const lines = measuredLines(pair, { label: "measured", values: pair.measured, width: 2 });
    if (pair.nominal) lines.push({ label: "as nominal", values: pair.nominal, colour: "nominal", dash: [6, 4] });
    if (pair.estimated) lines.push({ label: "as estimated", values: pair.estimated, colour: "estimated" });
    this.#chart.draw({ x: found.lags_s.map((lag) => 1000 * lag), lines, band: [2, 1], marks: [], time: false, include: [0], unit: printed(pair.unit), xUnit: "lag, ms", height: 240 });
  }

  /** The residuals come with every report. */
  show() {
    const found = this.health?.report?.equations ?? [];
    const rows = found.map((one) => ({
      cells: [
        html("b", {}, `(${one.equation})`),
        html("span", {}, one.title),
        one.evaluable ? html("span", { class: "number" }, figure(one.msd)) : html("span", {}, `not evaluable: ${one.reason}`),
        html("span", { class: "number" }, figure(one.msd_healthy)),
        html("span", { class: "number" }, one.evaluable && one.msd !== null && one.msd_healthy ? figure(one.msd / one.msd_healthy) : "–"),
        html("div", {}, ...one.parameters.map((each) => html("div", { class: "number" }, `${each.name} ${each.relative_change === null || each.standard_error === null ? "–" : within(each.relative_change, Z95 * each.standard_error)}`))),
      ],
    }));
    const heads = ["equation", "about", "mean squared difference", "healthy", "relative to healthy", "readings"];
    this.#residuals.replaceChildren(found.length ? table(heads, rows, "Residuals of the compatibility equations") : html("p", { class: "note" }, this.recorded && !this.health ? "No residuals: a paced replay evaluates nothing." : "No residuals: the compatibility equations need trained networks."));
  }
}

customElements.define("correlation-plot", CorrelationPlot);
