/** Names and urgency of states, and the most critical reading of a machine. */
import { figure, percent, printed, quantity, shownIn, within, Z95 } from "./figures.js";
import { parameterReadings } from "../machine/parameter-readings.js";

/** @import { Alarm, ChannelLevels, Health } from "./records.d.ts" */
/** @typedef {Pick<import("./records.d.ts").LevelLimits, "measure" | "alert" | "danger" | "fall">} LevelLimits */
/** @typedef {{title: string, value: string, limit: string, quantity: string, series: string, range: number[]}} Worst */

/** Every state of a machine in words, the most urgent first. @type {Record<string, string>} */
export const STATES = {
  danger: "danger",
  alert: "alert",
  "outside-model": "outside the model",
  "data-health": "sensor at fault",
  "not-evaluable": "not evaluable",
  "no-data": "no data",
  warming: "warming up",
  watching: "watching levels",
  unchanged: "unchanged",
  healthy: "healthy",
};

/** Abnormal states; all others are shown in grey. */
export const ABNORMAL = new Set(["danger", "alert", "outside-model", "data-health", "not-evaluable"]);

/** @param {string} state */
export const urgency = (state) => Object.keys(STATES).indexOf(state);

/** States of alarms that require attention. */
export const UNSEEN = new Set(["unacknowledged", "returned", "latched-unacknowledged"]);

/** Whether an alarm is about the machine itself, not about its data or the monitor. @param {{name: string}} alarm */
export const ofMachine = ({ name }) => !/^(stream|data|monitor)-/.test(name);

/** Whether an alarm is standing, i.e. must be shown to operators. @param {Alarm} alarm */
export const stands = (alarm) => alarm.raised || UNSEEN.has(alarm.state) || alarm.state.startsWith("latched");

/** Unacknowledged first, then danger, then the newest. @param {Alarm} one @param {Alarm} other */
export function byUrgency(one, other) {
  const rank = (/** @type {Alarm} */ alarm) =>
    (UNSEEN.has(alarm.state) ? 0 : 4) + (alarm.raised ? 0 : 2) + (alarm.severity === "danger" ? 0 : 1);
  return rank(one) - rank(other) || (other.raised_ns ?? other.since_ns) - (one.raised_ns ?? one.since_ns);
}

/** Names of a channel's measures. @type {Record<string, string>} */
const MEASURES = { x_half: "½×", x1: "1×", x2: "2×", x3: "3×", not_x1: "not 1×", mean: "gap", s_max: "S_max", crest: "crest factor", high: "high frequency" };

/** @param {string} measure */
export const measureText = (measure) => MEASURES[measure] ?? measure;

/** Unit of one level of a channel. @param {ChannelLevels} levels @param {string} measure */
export function levelUnit(levels, measure) {
  if (measure === "growth") return "× reference";
  if (["crest", "kurtosis"].includes(measure)) return "";
  if (measure === "velocity") return "mm/s rms";
  const detection = levels.detection === "peak to peak" ? "pp" : "rms";
  const plain = measure === "mean" || measure === "peak" || measure === "s_max";
  const suffix = plain ? "" : measure === "overall" || /^x/.test(measure) ? ` ${detection}` : " rms";
  return printed(levels.unit) + suffix;
}

/** A level's limits in words. @param {LevelLimits | undefined} limit @param {ChannelLevels} levels */
export function limitText(limit, levels) {
  if (!limit) return "";
  const [factor] = shownIn(levelUnit(levels, limit.measure));
  const parts = [["alert limit", limit.alert], ["danger limit", limit.danger], ["alert below", limit.fall]];
  return parts.filter(([, value]) => value !== null).map(([word, value]) => `${word} ${figure(factor * Number(value))}`).join(", ");
}

/** @param {Health} health @returns {(Worst & {nearness: number})[]} */
function levels(health) {
  return (health.report?.levels ?? []).flatMap((one) => {
    const limits = one.limits.length ? one.limits : [{ measure: one.velocity === null ? "overall" : "velocity", alert: null, danger: null, fall: null, state: "normal" }];
    return limits.map((limit) => {
      const value = /** @type {any} */ (one)[limit.measure];
      const beyond = { normal: 0, alert: 10, danger: 20 }[limit.state] ?? 0;
      return {
        title: `${one.channel} ${measureText(limit.measure)}`,
        value: quantity(value, levelUnit(one, limit.measure)),
        limit: limitText(limit, one) || "no limit",
        quantity: "level",
        series: `${one.channel}:${limit.measure}`,
        range: limit.alert === null ? [] : [0, limit.alert],
        nearness: beyond + (limit.alert ? value / limit.alert : 0),
      };
    });
  });
}

/** @param {Health} health @returns {(Worst & {nearness: number})[]} */
function parameters(health) {
  return parameterReadings(health).flatMap(({ read, parameter: { name, text, relative_change: change, standard_error: error }, seen }) => {
    if (!read || change === null || error === null) return [];
    const least = seen && (change < 0 ? seen.loss : seen.gain);
    return [{ title: text, value: within(change, Z95 * error), limit: least ? `detectable from ${percent(least)}` : "", quantity: "parameter", series: name, range: seen ? [seen.loss, seen.gain] : [], nearness: least ? change / least : 0 }];
  });
}

/**
 * The most critical reading of a machine: one that an alarm is about, else the one nearest to its limit.
 * @param {Health} health
 * @returns {Worst | null}
 */
export function worst(health) {
  // Alarms on the machine take precedence over alarms on its data.
  const rank = (/** @type {Alarm} */ one) => (ofMachine(one) ? 0 : 2) + (one.severity === "danger" ? 0 : 1);
  const alarm = health.alarms.filter((one) => one.raised).sort(byUrgency).sort((one, other) => rank(one) - rank(other))[0];
  const found = [...parameters(health), ...levels(health)].sort((one, other) => other.nearness - one.nearness);
  if (!alarm) return health.state === "not-evaluable" ? null : (found[0] ?? null); // the reason is more important than a level of a machine that stands still
  const same = found.find((one) => one.series === alarm.name || `level:${one.series}`.startsWith(`${alarm.name}:`));
  const value = alarm.relative_change !== null && alarm.standard_error !== null ? within(alarm.relative_change, Z95 * alarm.standard_error) : "";
  return { title: alarm.text, value: same?.value ?? value, limit: same?.limit ?? "", quantity: same?.quantity ?? "", series: same?.series ?? "", range: same?.range ?? [] };
}
