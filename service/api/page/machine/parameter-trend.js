import { monitor, pathOf } from "../monitor/monitor.js";
import { ReadingTrend } from "./reading-trend.js";

/** Changes of the parameters over time, with their 95 % intervals and the limits of the machine file. */
class ParameterTrend extends ReadingTrend {
  quantity = "parameter";
  title = "Parameters over time";
  /** @type {any} */
  #limits = null;

  async trended() {
    const read = this.health?.report?.parameters ?? [];
    if (!read.some((one) => one.relative_change !== null)) return [];
    this.#limits ??= (await monitor.ask(`${pathOf(this.place)}/configuration`)).file.alarms;
    return read.map(({ name, text }) => {
      const { raise_above: alert, danger_above: danger } = { ...this.#limits.limits, ...this.#limits.parameters[name] };
      return { name, alarm: name, title: `${text} (${name})`, unit: "change, %", scale: 100, alert: [-100 * alert, 100 * alert], danger: [-100 * danger, 100 * danger], zero: true };
    });
  }
}

customElements.define("parameter-trend", ParameterTrend);
