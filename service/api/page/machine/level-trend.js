import { figure, shownIn } from "../monitor/figures.js";
import { levelUnit, limitText, measureText } from "../monitor/states.js";
import { ReadingTrend } from "./reading-trend.js";

/** @import { LevelBound } from "../monitor/records.d.ts" */
/** @import { Zone } from "../elements/line-chart.js" */

/** Zones of a standard, in ascending order. @param {[number, number, number]} edges @returns {Zone[]} */
const zonesOf = ([first, second, third]) => [
  { from: 0, to: first, text: "zone A" },
  { from: first, to: second, text: "zone B", edge: true },
  { from: second, to: third, text: "zone C", colour: "zone-c" },
  { from: third, to: Infinity, text: "zone D", colour: "zone-d" },
];

/** @param {LevelBound} bound @returns {import("./reading-trend.js").Limit[]} */
function limitsOf({ source, zones, alert, danger, fall }) {
  const from = zones ? "" : `, ${source}`; // zones have their own names
  return [
    ...(alert === null ? [] : [{ at: alert, kind: /** @type {"alert"} */ ("alert"), text: `alert${from}` }]),
    ...(danger === null ? [] : [{ at: danger, kind: /** @type {"danger"} */ ("danger"), text: `danger${from}` }]),
    ...(fall === null ? [] : [{ at: fall, kind: /** @type {"alert"} */ ("alert"), text: `alert below${from}`, below: true }]),
  ];
}

/** The most important level of every channel over time, with the zones and limits that apply to the newest. */
export class LevelTrend extends ReadingTrend {
  quantity = "level";
  title = "Levels over time";
  note = "the band reaches from the lowest to the highest. Zones and limits are those of the newest window.";

  async trended() {
    // Any change may affect every level.
    const changed = (this.health?.report?.verdict?.changed ?? []).map((one) => ({ ...one, text: `${one.name} changed` }));
    return (this.health?.report?.levels ?? []).map((one) => {
      const usual = one.velocity === null ? "overall" : "velocity";
      const limit = one.limits.find(({ state }) => state !== "normal") ?? one.limits.find((each) => each.measure === usual) ?? one.limits[0];
      const measure = limit?.measure ?? usual;
      const bounds = limit?.bounds ?? (limit ? [{ ...limit, zones: null }] : []);
      const unit = levelUnit(one, measure);
      const [factor, shown] = shownIn(unit);
      const said = bounds.map((bound) => {
        const [first, second, third] = (bound.zones ?? []).map((edge) => figure(factor * edge));
        const limits = bound.zones ? `A to ${first}, B to ${second}, C to ${third}` : limitText({ ...bound, measure }, one);
        return `${bound.source}: ${`${limits} ${shown}`.trim()}${bound.zones ? ", D beyond" : ""}`;
      });
      return {
        name: `${one.channel}:${measure}`,
        alarm: `level:${one.channel}`,
        title: `${one.channel} ${measureText(measure)}`,
        unit,
        scale: 1,
        limits: bounds.flatMap(limitsOf),
        near: 0,
        zones: bounds.flatMap((bound) => (bound.zones ? zonesOf(bound.zones) : [])),
        said: said.length ? said : ["no limit"],
        zero: true,
        changed,
      };
    });
  }
}

customElements.define("level-trend", LevelTrend);
