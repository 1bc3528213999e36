/** The rotor of a machine file: along the shaft, and across it at bearing and disc. */

import { quantity } from "../monitor/figures.js";
import { svg } from "../elements/markup.js";
import { arrow, damper, LINE, parameter, rotation, sensorsRound, spring } from "./rotor-parts.js";

/** @import { Reading } from "../machine/parameter-readings.js" */
/** @import { MachineFile } from "../machine/machine-file.js" */
/** @import { Health } from "../monitor/records.d.ts" */

const [WIDTH, HEIGHT] = [360, 496];
const BEARING = { x: 196, y: 214 };
const DISC = { x: 250, y: 444 };
const ARROW = 30;

/** A length as written on drawings. @param {number} metres */
const millimetres = (metres) => quantity(1000 * metres, "mm");

/** @param {number} angle */
const degrees = (angle) => angle.toFixed(1).replace("-", "−");

/** Motor, shaft, bearing and disc from the side. @param {MachineFile} file @param {Health} health @param {Map<string, Reading>} readings */
function side(file, health, readings) {
  const { rotor } = file;
  const pulse = file.sensors.find((one) => one.quantity === "shaft_angle");
  const speed = health.report?.speed_rad_s ?? null;
  const rpm = speed !== null ? Math.abs((speed * 30) / Math.PI) : file.operation?.speed_rpm;
  const size = rotor?.shaft_length_m && rotor.shaft_diameter_m ? `${millimetres(rotor.shaft_length_m)}, ⌀ ${millimetres(rotor.shaft_diameter_m)}` : "";
  return [
    svg("rect", { class: "body", x: 4, y: 34, width: 62, height: 46, rx: 3 }),
    svg("text", { x: 35, y: 54, "text-anchor": "middle" }, "motor"),
    rpm ? svg("text", { x: 35, y: 70, "text-anchor": "middle", class: "least" }, `${rpm.toFixed(0)} rpm`) : null,
    svg("rect", { class: "body", x: 82, y: 46, width: 7, height: 22 }),
    parameter(readings.get("EI"), "EI, shaft", { x: 222, y: 15, anchor: "middle" }, svg("rect", { class: "solid", x: 66, y: 54, width: 264, height: 6 })),
    svg("path", { class: "body", d: "M126 38H150V76H126ZM118 90H158M138 76V90" }),
    svg("path", { class: "thin", d: "M120 96 l5 -6 M130 96 l5 -6 M140 96 l5 -6 M150 96 l5 -6" }),
    svg("text", { x: 138, y: 110, "text-anchor": "middle" }, "bearing"),
    svg("rect", { class: "body", x: 300, y: 16, width: 14, height: 82 }),
    svg("text", { x: 307, y: 112, "text-anchor": "middle" }, "disc"),
    size && svg("path", { class: "thin", d: "M152 84H298M157 81 l-5 3 l5 3M293 81 l5 3 l-5 3" }),
    size && svg("text", { x: 226, y: 99, "text-anchor": "middle", class: "least" }, size),
    pulse && svg("path", { class: "mark", d: "M98 52 L94 42 H102Z" }),
    pulse && svg("text", { x: 98, y: 30, "text-anchor": "middle", class: "least" }, pulse.name),
  ];
}

/** Springs, dampers and sensors at the bearing. @param {MachineFile} file @param {Health} health @param {Map<string, Reading>} readings */
function bearing(file, health, readings) {
  const { x, y } = BEARING;
  const direction = Math.sign(health.report?.speed_rad_s ?? 0);
  const there = file.sensors.filter((one) => one.location === "bearing");
  return [
    svg("path", { class: "thin", d: "M0 124H360" }),
    svg("text", { x: 4, y: 144, class: "place" }, "across the bearing"),
    svg("path", { class: "solid", d: `M${x - 70} ${y - 28}V${y + 28}M${x - 30} ${y + 72}H${x + 30}` }),
    parameter(readings.get("k_by"), "k_by", { x: x - 78, y: y - 12, anchor: "end" }, spring(x - 70, y - 11, 48)),
    parameter(readings.get("c_by"), "c_by", { x: x - 78, y: y + 36, anchor: "end" }, damper(x - 70, y + 11, 48)),
    parameter(readings.get("k_bz"), "k_bz", { x: x - 6, y: y + 88, anchor: "end" }, spring(x - 11, y + 24, 48, 90)),
    parameter(readings.get("c_bz"), "c_bz", { x: x + 6, y: y + 88, anchor: "start" }, damper(x + 11, y + 24, 48, 90)),
    svg("circle", { class: "body", cx: x, cy: y, r: 26 }),
    svg("circle", { class: "solid", cx: x, cy: y, r: 5 }),
    direction && rotation(x, y, 15, direction),
    ...sensorsRound(there, health, { x, y }),
  ];
}

/** Unbalance and sensors at the disc, at the moment of the phase reference's pulse. @param {MachineFile} file @param {Health} health @param {Map<string, Reading>} readings */
function disc(file, health, readings) {
  const { x, y } = DISC;
  const reading = readings.get("e");
  const vector = (reading?.read && reading.parameter.vector) || null;
  const change = reading?.read ? (reading.parameter.relative_change ?? 0) : 0;
  const phased = file.sensors.some((one) => one.quantity === "shaft_angle");
  const nominal = ((file.operation?.unbalance_phase_rad ?? 0) * 180) / Math.PI;
  const turned = Math.sign(health.report?.speed_rad_s || 1) * (vector?.turned_deg ?? 0);
  const grown = Math.min(Math.max(1 + (vector?.magnitude_change ?? change), 0.15), 1.5);
  const apart = vector?.turned_interval_95_deg ? vector.turned_interval_95_deg[1] - vector.turned_interval_95_deg[0] : NaN;
  const there = file.sensors.filter((one) => one.location === "disc");
  return [
    svg("path", { class: "thin", d: "M0 344H360" }),
    svg("text", { x: 4, y: 364, class: "place" }, "across the disc"),
    svg("text", { x: 4, y: 379, class: "least" }, phased ? "at the keyphasor's pulse" : "direction not known"),
    svg("circle", { class: "body", cx: x, cy: y, r: 40 }),
    svg("circle", { class: "solid", cx: x, cy: y, r: 5 }),
    svg("path", { class: "mark", d: `M${x + 40} ${y} l-8 -4 v8Z` }),
    arrow(x, y, ARROW, nominal, "nominal"),
    parameter(reading, "e, unbalance", { x: 4, y: 418, anchor: "start" }, arrow(x, y, ARROW * grown, nominal + turned, "now")),
    vector && vector.turned_deg !== null && svg("text", { x: 4, y: 418 + 3 * LINE }, `turned ${degrees(vector.turned_deg)}° ± ${degrees(apart / 2)}°`),
    ...sensorsRound(there, health, { x, y, radius: 40 }),
  ];
}

/**
 * @param {MachineFile} file
 * @param {Health} health
 * @param {Reading[]} readings
 * @param {string} said
 */
export function rotorPicture(file, health, readings, said) {
  const by = new Map(readings.map((one) => [one.stated.name, one]));
  return svg(
    "svg",
    { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": said },
    ...side(file, health, by),
    ...bearing(file, health, by),
    ...disc(file, health, by),
  );
}
