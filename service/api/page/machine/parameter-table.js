import { interval, percent, within, Z95 } from "../monitor/figures.js";
import { html, renew, table } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { parameterReadings } from "./parameter-readings.js";
import "../elements/state-mark.js";

/** @import { Opinion } from "../monitor/records.d.ts" */
/** @import { Reading } from "./parameter-readings.js" */

/** Reading of a parameter by another diagnostician, and whether it agrees. @param {Opinion} opinion @param {string} name */
function other(opinion, name) {
  const said = opinion.parameters.find((one) => one.name === name);
  if (!said || said.relative_change === null || said.standard_error === null) return html("span", { class: "number" }, "–");
  const apart = opinion.agreement.some((one) => one.name === name && one.verdict === "disagree");
  return html("span", { class: "number" }, within(said.relative_change, Z95 * said.standard_error), apart && html("strong", {}, " disagrees"));
}

/** Change and interval, or why there is none. @param {Reading} reading */
function said({ read, why, parameter }) {
  if (!read || !parameter.interval_95) return [why, ""];
  return [html("b", { class: "number" }, percent(parameter.relative_change)), html("span", { class: "number" }, interval(parameter.interval_95))];
}

/** Readings of each parameter by all diagnosticians, and the minimum detectable changes. */
class ParameterTable extends MachineElement {
  show() {
    const report = this.health?.report;
    const verdict = report?.verdict;
    this.hidden = !report || !verdict || !report.parameters.some((one) => one.relative_change !== null);
    if (this.hidden || !report || !verdict) return this.replaceChildren();
    const rows = parameterReadings(this.health).map((reading) => {
      const { stated, parameter, seen, severity } = reading;
      const name = html("div", {}, html("b", {}, stated.text), html("small", {}, ` ${stated.name}`), parameter.vector && html("div", { class: "note" }, parameter.vector.text));
      const least = html("span", { class: "number" }, seen ? `${percent(seen.loss)} / ${percent(seen.gain)}` : "");
      return {
        key: stated.name,
        attributes: { class: severity || null },
        cells: [name, severity ? html("state-mark", { state: severity }) : "", ...said(reading), least, ...report.opinions.map((opinion) => other(opinion, stated.name))],
      };
    });
    const heads = ["parameter", "alarm", "change", "95 % interval", "detectable from", ...report.opinions.map((one) => one.by)];
    const silent = report.opinions.filter((one) => one.reason).map((one) => `${one.by}: ${one.reason}. `);
    renew(
      this,
      table(heads, rows, "Parameters"),
      html(
        "p",
        { class: "note" },
        `Decided on the ${report.parameters[0].by}${report.opinions.length ? "; the others read the whole window in addition" : ""}. `,
        verdict.settled ? "" : "While the window straddles a change, the values are those of the machine since then. ",
        ...silent,
        "Detectable from: smallest loss and gain that one window shows with 95 % probability.",
      ),
    );
  }
}

customElements.define("parameter-table", ParameterTable);
