import { figure, printed, shownIn } from "../monitor/figures.js";
import { html, renew, table } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { levelUnit, limitText, measureText } from "../monitor/states.js";
import "../elements/state-mark.js";

const MEASURES = ["overall", "velocity", "x1", "x2", "mean", "crest", "kurtosis"];

/** @param {import("../monitor/records.d.ts").ChannelLevels} one @param {string} measure */
function leveled(one, measure) {
  const value = /** @type {any} */ (one)[measure];
  return value === null ? null : value * shownIn(levelUnit(one, measure))[0];
}

/** Vibration levels of each channel with their limits; levels beyond a limit are marked. */
class LevelTable extends MachineElement {
  show() {
    const report = this.health?.report;
    this.hidden = !report?.levels.length;
    if (!report?.levels.length) return this.replaceChildren();
    const shown = MEASURES.filter((measure) => report.levels.some((one) => /** @type {any} */ (one)[measure] !== null));
    const rows = report.levels.map((one) => {
      const worst = one.limits.find((limit) => limit.state === "danger") ?? one.limits.find((limit) => limit.state === "alert");
      const limits = one.limits.map((limit) =>
        html("div", { title: limit.source }, `${measureText(limit.measure)}: ${limitText(limit, one)} ${shownIn(levelUnit(one, limit.measure))[1]}`, html("small", {}, ` ${limit.source}`)),
      );
      const detection = one.detection === "peak to peak" ? "pp" : "rms";
      return {
        key: one.channel,
        attributes: { class: worst?.state },
        cells: [
          html("b", {}, one.channel),
          worst ? html("div", {}, html("state-mark", { state: worst.state }), html("div", {}, worst.text)) : "",
          `${shownIn(printed(one.unit))[1]} ${detection}`,
          ...shown.map((measure) => html("span", { class: "number" }, figure(leveled(one, measure)), measure === "mean" && one.mean !== null && ` ${shownIn(levelUnit(one, measure))[1]}`)),
          one.zone,
          limits.length ? html("details", {}, html("summary", {}, `${limits.length}`), ...limits) : "none",
        ],
      };
    });
    const heads = ["channel", "alarm", "unit", ...shown.map((one) => (one === "velocity" ? `velocity, ${shownIn("mm/s rms")[1]}` : measureText(one))), "zone", "limits"];
    const growth = report.level_growth?.text;
    renew(this, table(heads, rows, "Vibration levels"), html("p", { class: "note" }, growth ? `${growth[0].toUpperCase()}${growth.slice(1)}.` : ""));
  }
}

customElements.define("level-table", LevelTable);
