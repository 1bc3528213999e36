/** Picture of a machine of which only the sensors are known: their locations and quantities. */

import { quantity } from "../monitor/figures.js";
import { svg } from "../elements/markup.js";
import { levelUnit, measureText, STATES } from "../monitor/states.js";
import { sensorState } from "../machine/machine-file.js";
import { MARKS } from "./rotor-parts.js";

/** @import { Sensor } from "../machine/machine-file.js" */
/** @import { Health } from "../monitor/records.d.ts" */

const [WIDTH, LINE, SHAFT] = [360, 19, 22];

/** The level of a channel that has a limit, else the overall level. @param {Sensor} sensor @param {Health} health */
function level(sensor, health) {
  const found = health.report?.levels.find((one) => one.channel === sensor.name);
  if (!found) return "no level yet";
  const measure = (found.limits.find((one) => one.state !== "normal") ?? found.limits[0])?.measure ?? (found.velocity === null ? "overall" : "velocity");
  const value = /** @type {any} */ (found)[measure] ?? null;
  return value === null ? `${measureText(measure)}: none` : `${measure === "overall" ? "" : `${measureText(measure)} `}${quantity(value, levelUnit(found, measure))}`;
}

/**
 * Measuring points one after the other along the shaft.
 * @param {Sensor[]} sensors
 * @param {Health} health
 * @param {string} said
 */
export function plainPicture(sensors, health, said) {
  const places = new Map(sensors.map((one) => [one.location, sensors.filter((other) => other.location === one.location)]));
  /** @type {SVGElement[]} */
  const drawn = [];
  let y = 14;
  for (const [place, there] of places) {
    const tall = LINE * (there.length + 1);
    drawn.push(
      svg("rect", { class: "body", x: SHAFT - 13, y, width: 26, height: tall - 4, rx: 3 }),
      svg("text", { x: 56, y: y + 13, class: "place" }, place),
      ...there.map((one, at) => {
        const state = sensorState(one, health);
        const row = y + 13 + LINE * (at + 1);
        const angle = typeof one.angle_deg === "number" ? ` at ${one.angle_deg}°` : "";
        const text = one.quantity === "shaft_angle" ? "shaft angle" : level(one, health);
        return svg(
          "g",
          { class: `sensor ${state}` },
          svg("title", {}, `${one.name}: ${one.quantity}, ${one.unit}, ${one.direction}${angle}`),
          svg("path", { d: `M${SHAFT + 15} ${row - 4} l9 -4.5 v9Z` }),
          svg("text", { x: 56, y: row, class: "name" }, `${one.name}${state ? ` ${MARKS[state] ?? ""} ${STATES[state]}` : ""}`),
          svg("text", { x: WIDTH - 2, y: row, "text-anchor": "end" }, text),
        );
      }),
    );
    y += tall + 8;
  }
  return svg("svg", { viewBox: `0 0 ${WIDTH} ${y + 4}`, role: "img", "aria-label": said }, svg("path", { class: "solid", d: `M${SHAFT} 2V${y + 2}` }), ...drawn);
}
