import { ReadingTrend } from "./reading-trend.js";
import { levelUnit, measureText } from "../monitor/states.js";

/** The leading level of every channel over time, with its limits. */
export class LevelTrend extends ReadingTrend {
  quantity = "level";
  title = "Levels over time";

  async trended() {
    // Whatever changed, every level may show it.
    const changed = (this.health?.report?.verdict?.changed ?? []).map((one) => ({ ...one, text: `${one.name} changed` }));
    return (this.health?.report?.levels ?? []).map((one) => {
      const measure = one.limits.find((limit) => limit.state !== "normal")?.measure ?? (one.velocity === null ? "overall" : "velocity");
      const limit = one.limits.find((each) => each.measure === measure);
      const there = (/** @type {number | null | undefined} */ value) => (value === null || value === undefined ? [] : [value]);
      return {
        name: `${one.channel}:${measure}`,
        alarm: `level:${one.channel}`,
        title: `${one.channel} ${measureText(measure)}`,
        unit: levelUnit(one, measure),
        scale: 1,
        alert: [...there(limit?.alert), ...there(limit?.fall)],
        danger: there(limit?.danger),
        zero: true,
        changed,
      };
    });
  }
}

customElements.define("level-trend", LevelTrend);
