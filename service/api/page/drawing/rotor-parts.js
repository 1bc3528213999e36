/** Parts of the drawing of a rotor, at their physical positions: y to the right, z up. */

import { percent, within, Z95 } from "../monitor/figures.js";
import { svg } from "../elements/markup.js";
import { STATES } from "../monitor/states.js";
import { angleOf, sensorState } from "../machine/machine-file.js";

/** @import { Reading } from "../machine/parameter-readings.js" */
/** @import { Sensor } from "../machine/machine-file.js" */
/** @import { Health } from "../monitor/records.d.ts" */

export const LINE = 14;
export const MARKS = /** @type {Record<string, string>} */ ({ danger: "◆", alert: "▲", "data-health": "⬢" });
const RADIUS = 26;

/**
 * Lines of text below each other.
 * @param {{text: string, kind?: string}[]} lines
 * @param {number} x
 * @param {number} y of the first
 * @param {string} anchor
 */
function lines(lines, x, y, anchor) {
  return lines.map(({ text, kind }, at) => svg("text", { x, y: y + at * LINE, "text-anchor": anchor, class: kind }, text));
}

/** Reading of a parameter, and in brackets the minimum detectable loss and gain. @param {Reading | undefined} reading @param {string} name */
function said(reading, name) {
  if (!reading) return [{ text: name, kind: "name" }];
  const { severity, read, why, seen, parameter } = reading;
  const found = read && parameter.standard_error !== null ? within(Number(parameter.relative_change), Z95 * parameter.standard_error) : why.startsWith("not evaluable") ? "not evaluable" : "too little data yet";
  const mark = severity ? ` ${MARKS[severity] ?? ""} ${STATES[severity] ?? severity}` : "";
  const least = seen ? `(${percent(seen.loss).replace(" %", "")} / ${percent(seen.gain)})` : "";
  return [{ text: `${name}${mark}`, kind: "name" }, { text: found }, { text: least, kind: "least" }].filter((one) => one.text);
}

/**
 * A parameter: its part of the machine and its reading, in the colour of its alarm.
 * @param {Reading | undefined} reading
 * @param {string} name
 * @param {{x: number, y: number, anchor: string}} at
 * @param {...SVGElement} part
 */
export function parameter(reading, name, { x, y, anchor }, ...part) {
  const title = reading ? `${reading.stated.text}${reading.why ? `: ${reading.why}` : ""}` : name;
  return svg("g", { class: `part ${reading?.severity ?? ""}` }, svg("title", {}, title), ...part, ...lines(said(reading, name), x, y, anchor));
}

/** A spring from a point to the right, or turned. @param {number} x @param {number} y @param {number} length @param {number} turned */
export function spring(x, y, length, turned = 0) {
  const [lead, step] = [length * 0.16, (length * 0.68) / 8];
  const zigzag = Array.from({ length: 7 }, (_, at) => `${(lead + (at + 1) * step).toFixed(1)},${at % 2 ? 5 : -5}`).join(" ");
  return svg("polyline", { points: `0,0 ${lead},0 ${zigzag} ${length - lead},0 ${length},0`, transform: `translate(${x} ${y}) rotate(${turned})` });
}

/** A damper from a point to the right, or turned. @param {number} x @param {number} y @param {number} length @param {number} turned */
export function damper(x, y, length, turned = 0) {
  const [from, middle, to] = [length * 0.3, length * 0.5, length * 0.66];
  return svg("path", { d: `M0 0H${from}M${to} -7H${from}V7H${to}M${middle} -5V5M${middle} 0H${length}`, transform: `translate(${x} ${y}) rotate(${turned})` });
}

/** An arrow from a centre. @param {number} x @param {number} y @param {number} length @param {number} angle_deg from y towards z @param {string} kind */
export function arrow(x, y, length, angle_deg, kind) {
  return svg("path", { d: `M0 0H${length}M${length - 7} -4 L${length} 0 L${length - 7} 4`, transform: `translate(${x} ${y}) rotate(${-angle_deg})`, class: kind });
}

/** An arc around a centre in the sense of rotation. @param {number} x @param {number} y @param {number} radius @param {number} direction */
export function rotation(x, y, radius, direction) {
  const end = radius * Math.SQRT1_2;
  return svg("path", { d: `M${end} ${-end} A${radius} ${radius} 0 0 0 ${-end} ${-end}M${-end + 8} ${-end - 4} L${-end} ${-end} L${-end + 2} ${-end - 9}`, transform: `translate(${x} ${y}) scale(${direction} 1)`, class: "thin" });
}

/**
 * Sensors around a location, grouped by direction, each with its name.
 * @param {Sensor[]} sensors
 * @param {Health} health
 * @param {{x: number, y: number, radius?: number}} at
 */
export function sensorsRound(sensors, health, { x, y, radius = RADIUS }) {
  /** @type {Map<number, Sensor[]>} */
  const ways = new Map();
  for (const one of sensors) {
    const angle = angleOf(one);
    if (angle !== null) ways.set(angle, [...(ways.get(angle) ?? []), one]);
  }
  return [...ways].map(([angle, there]) => {
    const [across, up] = [Math.cos((angle * Math.PI) / 180), Math.sin((angle * Math.PI) / 180)];
    const abnormal = there.map((one) => sensorState(one, health)).find(Boolean) ?? "";
    const anchor = across > 0.3 ? "start" : across < -0.3 ? "end" : "middle";
    const rise = up > 0.3 ? -LINE * (there.length - 1) - 3 : up < -0.3 ? 12 : 4 - (LINE / 2) * (there.length - 1);
    const names = there.map((one) => {
      const state = sensorState(one, health);
      return { text: `${one.name}${state ? ` ${MARKS[state] ?? ""} ${STATES[state] ?? state}` : ""}`, kind: state };
    });
    return svg(
      "g",
      { class: `sensor ${abnormal}` },
      svg("title", {}, there.map((one) => `${one.name}: ${one.quantity}, ${one.unit}, at ${angle}°`).join("\n")),
      svg("path", { d: "M2 0 L10 -4.5 V4.5Z", transform: `translate(${x} ${y}) rotate(${-angle}) translate(${radius} 0)` }),
      ...lines(names, x + across * (radius + 15), y - up * (radius + 12) + rise, anchor),
    );
  });
}
