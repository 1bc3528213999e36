import { ReadingTrend } from "./reading-trend.js";

/** @param {"alert" | "danger"} kind @param {number} limit @returns {import("./reading-trend.js").Limit[]} */
const both = (kind, limit) => [-100 * limit, 100 * limit].map((at) => ({ at, kind, text: kind, below: at < 0 }));

/** Changes of the parameters over time, with their 95 % intervals and the limits of the machine file. */
export class ParameterTrend extends ReadingTrend {
  quantity = "parameter";
  title = "Parameters over time";

  /** Limits of the machine file. @returns {Promise<{limits: any, parameters: Record<string, any>}>} */
  async limits() {
    return (await this.machineFile()).alarms;
  }

  async trended() {
    const read = this.health?.report?.parameters ?? [];
    if (!read.some((one) => one.relative_change !== null)) return [];
    const changed = (this.health?.report?.verdict?.changed ?? []).map((one) => ({ ...one, text: "changed" }));
    const { limits, parameters } = await this.limits();
    return read.map(({ name, text }) => {
      const { raise_above: alert, danger_above: danger } = { ...limits, ...parameters[name] };
      return { name, alarm: name, title: `${text} (${name})`, unit: "change, %", scale: 100, limits: [...both("alert", alert), ...both("danger", danger)], near: 10, zero: true, changed: changed.filter((one) => one.name === name) };
    });
  }
}

customElements.define("parameter-trend", ParameterTrend);
