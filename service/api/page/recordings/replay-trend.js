import { LevelTrend } from "../machine/level-trend.js";
import { ParameterTrend } from "../machine/parameter-trend.js";

/** @import { AlarmEventData as AlarmEvent, ReadingBucket as Bucket, Report } from "../monitor/records.d.ts" */
/** @import { Trended } from "../machine/reading-trend.js" */
/** Results of a replay. @typedef {{reports: Report[], events: AlarmEvent[], limits: Record<string, {raise_above: number, danger_above: number}>}} Found */

/** @param {string} name @param {Report} report @param {number | null} value @param {number | null} error @returns {Bucket[]} */
const reading = (name, report, value, error) => (value === null ? [] : [{ name, start_ns: report.end_ns, length_ns: 0, count: 1, minimum: value, mean: value, maximum: value, mean_standard_error: error }]);

/** Changes of the parameters over the time of a replay, with its limits. */
class ReplayParameters extends ParameterTrend {
  /** @type {Found} */
  found = { reports: [], events: [], limits: {} };

  async limits() {
    return { limits: {}, parameters: this.found.limits };
  }

  async readings() {
    const buckets = this.found.reports.flatMap((report) => report.parameters.flatMap((one) => reading(one.name, report, one.relative_change, one.standard_error)));
    return { buckets, events: this.found.events };
  }
}

/** Levels over the time of a replay. */
class ReplayLevels extends LevelTrend {
  /** @type {Found} */
  found = { reports: [], events: [], limits: {} };

  /** @param {Trended[]} shown */
  async readings(shown) {
    const named = new Map(shown.map((one) => [one.name, one.name.split(":")]));
    const buckets = this.found.reports.flatMap((report) =>
      [...named].flatMap(([name, [channel, measure]]) => {
        const levels = /** @type {any} */ (report.levels.find((one) => one.channel === channel));
        return reading(name, report, levels?.[measure] ?? null, null);
      }),
    );
    return { buckets, events: this.found.events };
  }
}

customElements.define("replay-parameters", ReplayParameters);
customElements.define("replay-levels", ReplayLevels);
