import { clock, stretch } from "../monitor/figures.js";
import { html, svg } from "../elements/markup.js";

const [WIDTH, HEIGHT, LEAST] = [1000, 12, 3];
const [BEGINS, ENDS] = [new Set(["raised", "escalated"]), new Set(["cleared", "reset"])];

/** @import { AlarmEventData as AlarmEvent } from "../monitor/records.d.ts" */
/** @typedef {{from: number, to: number, severity: string, text: string}} Spell */

/** Times during which an alarm was raised, from its events, oldest first; it may have been raised before the first of them. @param {AlarmEvent[]} events @param {number} start @param {number} end @returns {Spell[]} */
export function spells(events, start, end) {
  /** @type {Spell[]} */
  const found = [];
  /** @type {Spell | null} */
  let open = null;
  for (const one of events) {
    if (!found.length && (one.kind === "cleared" || one.kind === "escalated")) {
      found.push({ from: start, to: one.time_ns, severity: one.kind === "cleared" ? one.severity : "alert", text: "raised before" });
    }
    if (open && (BEGINS.has(one.kind) || ENDS.has(one.kind))) {
      open.to = one.time_ns;
      open = null;
    }
    if (BEGINS.has(one.kind)) found.push((open = { from: one.time_ns, to: end, severity: one.severity, text: one.text }));
  }
  return found;
}

/** Time line with one row per alarm, which shows when it was raised. @param {AlarmEvent[]} events newest first @param {number} now @returns {HTMLElement | null} */
export function timeLine(events, now) {
  if (!events.length) return null;
  const [first, end] = [events[events.length - 1].time_ns, Math.max(now, events[0].time_ns)];
  const x = (/** @type {number} */ ns) => (WIDTH * (ns - first)) / (end - first || 1);
  const names = [...new Set(events.map((one) => one.name))];
  const rows = names.flatMap((name) => {
    const stood = spells(events.filter((one) => one.name === name).reverse(), first, end);
    if (!stood.length) return [];
    const bars = stood.map((one) => {
      const from = Math.min(x(one.from), WIDTH - LEAST);
      const [top, height] = one.severity === "danger" ? [0, HEIGHT] : [HEIGHT / 4, HEIGHT / 2];
      return svg("rect", { class: one.severity, x: from, width: Math.max(LEAST, x(one.to) - from), y: top, height }, svg("title", {}, `${one.text}, ${stretch(one.from, one.to)}`));
    });
    return [html("dt", {}, name), html("dd", {}, svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", role: "img", "aria-label": `${name} was raised ${stood.length === 1 ? "once" : `${stood.length} times`} between ${clock(first)} and ${clock(end)}` }, ...bars))];
  });
  if (!rows.length) return null;
  return html("div", { class: "alarm-time-line" }, html("dl", {}, ...rows), html("p", { class: "note" }, `${stretch(first, end)}; high bars are danger, low ones alert.`));
}
