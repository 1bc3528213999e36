import { monitor, pathOf } from "../monitor/monitor.js";

/**
 * The parts of the machine file that the page uses; docs/machine-file.md explains its fields.
 *
 * @typedef {{name: string, quantity: string, location: string, direction: string, unit: string, angle_deg?: number | null}} Sensor
 * @typedef {{raise_above: number, danger_above: number}} Limits
 * @typedef {{description: string, rotor: Record<string, number | null> | null, operation: {speed_rpm: number, unbalance_phase_rad: number} | null, sensors: Sensor[], alarms: {limits: Limits, parameters: Record<string, Limits>}}} MachineFile
 */

/** @type {Map<string, Promise<MachineFile>>} */
const known = new Map();

/**
 * The machine file in use; requested once for all elements.
 * @param {string} place
 * @param {string} [hash] of the machine file; a new hash causes a new request
 */
export function machineFile(place, hash = "") {
  const key = `${place} ${hash}`;
  const found = known.get(key) ?? monitor.ask(`${pathOf(place)}/configuration`).then((/** @type {{file: MachineFile}} */ answer) => answer.file);
  known.set(key, found);
  found.catch(() => known.delete(key));
  return found;
}

const RATES = /** @type {Record<string, string>} */ ({ displacement: "", velocity: "_dot", acceleration: "_ddot", tilt: "", tilt_rate: "_dot" });
const TILTS = /** @type {Record<string, string>} */ ({ y: "psi", z: "phi" });

/** Angle of a sensor's axis from y towards z; null if its direction does not determine it. @param {Sensor} sensor */
export const angleOf = (sensor) => sensor.angle_deg ?? { y: 0, z: 90 }[sensor.direction] ?? null;

/** Name of the state that a sensor measures, as in reports. @param {Sensor} sensor */
export function stateOf(sensor) {
  const { quantity, location, direction, name } = sensor;
  if (quantity === "shaft_angle") return "theta";
  const number = { bearing: 1, disc: 2 }[location];
  const rate = RATES[quantity] ?? "";
  const angle = angleOf(sensor);
  if (!number || angle === null) return `@${name}`;
  if (quantity.startsWith("tilt")) return `${TILTS[direction]}${rate}`;
  const plane = { 0: "y", 90: "z" }[((angle % 360) + 360) % 360];
  return plane ? `${plane}${number}${rate}` : `${location}@${angle}${rate}`;
}

/** Why a sensor is abnormal: a fault, or a level alarm; empty if it is normal. @param {Sensor} sensor @param {import("../monitor/records.d.ts").Health} health */
export function sensorState(sensor, health) {
  if (health.report?.sensors.some((one) => one.states.includes(stateOf(sensor)))) return "data-health";
  return health.alarms.find((one) => one.raised && one.name === `level:${sensor.name}`)?.severity ?? "";
}
