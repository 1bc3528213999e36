/** Formats numbers with units, and times. */

const MINUS = "−";
const KEPT = "rotorwatch.times";
export const Z95 = 1.96;

/** @param {string} text */
const signed = (text) => text.replace("-", MINUS);

/**
 * Format a number to three significant digits, without exponent if that is readable.
 * @param {number | null | undefined} value
 */
export function figure(value) {
  if (value === null || value === undefined) return "–";
  const size = Math.abs(value);
  if (size !== 0 && (size < 1e-3 || size >= 1e6)) return signed(value.toExponential(2));
  return signed(size >= 100 ? value.toFixed(0) : String(Number(value.toPrecision(3))));
}

/**
 * A relative change, with its sign.
 * @param {number | null | undefined} ratio
 * @param {number} [digits] after the point
 */
export function percent(ratio, digits = 1) {
  if (ratio === null || ratio === undefined) return "–";
  const text = (100 * ratio).toFixed(digits);
  if (!Number(text)) return `${(0).toFixed(digits)} %`;
  return `${ratio > 0 ? "+" : ""}${signed(text)} %`;
}

/** A relative change with the half-width of its interval, which is never rounded to zero. @param {number} ratio @param {number} error */
export function within(ratio, error) {
  const digits = error > 0 && error < 0.0005 ? 1 - Math.floor(Math.log10(100 * error)) : 1;
  return `${percent(ratio, digits)} ± ${(100 * error).toFixed(digits)} %`;
}

/** @param {[number, number]} interval */
export const interval = ([low, high]) => `${percent(low)} … ${percent(high)}`;

/** A unit as it is printed. @param {string} unit */
export function printed(unit) {
  return unit.replace(/^u/, "µ").replace("/s2", "/s²").replace("^2", "²");
}

/** Whether lengths and velocities are shown in mil and in/s. */
export const inches = () => localStorage.getItem("rotorwatch.units") === "inches";

/** @param {boolean} wanted */
export const showInches = (wanted) => localStorage.setItem("rotorwatch.units", wanted ? "inches" : "metres");

/** Factor from a unit to the unit shown, and that unit. @param {string} unit @returns {[number, string]} */
export function shownIn(unit) {
  const [, length] = /(µm|mm)/.exec(unit) ?? [];
  if (!inches() || !length || unit.includes("/s²")) return [1, unit];
  const factor = 1 / 25.4; // µm in a mil, mm in an inch
  return [unit.includes("²") ? factor ** 2 : factor, unit.replace(length, length === "µm" ? "mil" : "in")];
}

/** A number with its unit. @param {number | null | undefined} value @param {string} unit */
export function quantity(value, unit) {
  const [factor, shown] = shownIn(unit);
  return `${figure(value === null || value === undefined ? value : factor * value)} ${shown}`.trim();
}

/** Whether times are shown as local times. */
export const local = () => localStorage.getItem(KEPT) === "local";

/** @param {boolean} wanted */
export const showLocal = (wanted) => localStorage.setItem(KEPT, wanted ? "local" : "utc");

/** @param {Intl.DateTimeFormatOptions} options */
const format = (options) =>
  new Intl.DateTimeFormat("sv-SE", { hourCycle: "h23", ...options, ...(local() ? {} : { timeZone: "UTC" }) });

/**
 * A time of the data or of an event; date and zone with it.
 * @param {number | null | undefined} ns
 */
export function clock(ns) {
  if (ns === null || ns === undefined) return "–";
  return `${format({ dateStyle: "short", timeStyle: "medium" }).format(ns / 1e6)}${local() ? "" : " UTC"}`;
}

/** A time span, with the date once; for a short one, start and duration. @param {number} start_ns @param {number} end_ns */
export function stretch(start_ns, end_ns) {
  if (end_ns - start_ns < 2e9) return `${clock(start_ns)}, ${figure((end_ns - start_ns) / 1e9)} s`;
  const [from, to] = [clock(start_ns), clock(end_ns)];
  return `${from.replace(" UTC", "")} to ${from.slice(0, 10) === to.slice(0, 10) ? to.slice(11) : to}`;
}

/**
 * Labels of times along an axis: time of day as fine as the steps, or month and day as in other dates; empty for null.
 * @param {(number | null)[]} seconds
 * @param {number} step_s
 */
export function ticks(seconds, step_s) {
  const time = format({ hour: "2-digit", minute: "2-digit", ...(step_s < 60 ? { second: "2-digit" } : {}) });
  const first = seconds.findIndex((each) => each !== null);
  return seconds.map((each, at) => (each === null ? "" : (step_s >= 86_400 ? "" : `${time.format(each * 1e3)}`) + (step_s >= 86_400 || at === first ? `\n${clock(each * 1e9).slice(5, 10)}` : "")));
}

/** A pause longer than this multiple of the shortest step between readings is a gap. */
export const GAP = 2.5;

/** Shortest step between times. @param {number[]} times */
export const shortest = (times) => Math.min(...times.slice(1).map((each, at) => each - times[at]), Infinity);

/** Format the size of a file or database. @param {number} bytes */
export function size(bytes) {
  const [power, unit] = bytes < 1e6 ? [1e3, "kB"] : bytes < 1e9 ? [1e6, "MB"] : [1e9, "GB"];
  return `${figure(bytes / power)} ${unit}`;
}

/** Format a duration roughly. @param {number} seconds */
export function lasting(seconds) {
  if (seconds < 100) return `${seconds.toFixed(0)} s`;
  if (seconds < 100 * 60) return `${(seconds / 60).toFixed(0)} min`;
  if (seconds < 72 * 3600) return `${(seconds / 3600).toFixed(0)} h`;
  return `${(seconds / 86400).toFixed(0)} days`;
}
