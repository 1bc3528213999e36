import { figure, printed, quantity, shownIn } from "../monitor/figures.js";
import { html, svg } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { plane, REACH, roundUp } from "./plane.js";

const REVOLUTIONS = 8;

/** @import { OrbitEllipse as Ellipse, OrbitSnapshot as Orbits, PlaceOrbit } from "../monitor/records.d.ts" */

/** Positions of the shaft at the pulses of the phase reference. @param {PlaceOrbit} orbit @param {number[]} pulses_s */
function marked({ path }, pulses_s) {
  if (!path) return [];
  return pulses_s.flatMap((pulse) => {
    const at = path.times_s.findIndex((time) => time >= pulse);
    if (at < 1) return at === 0 ? [[path.y[0], path.z[0]]] : [];
    const share = (pulse - path.times_s[at - 1]) / (path.times_s[at] - path.times_s[at - 1]);
    const between = (/** @type {number[]} */ values) => values[at - 1] + share * (values[at] - values[at - 1]);
    return [[between(path.y), between(path.z)]];
  });
}

/** Orbit at one location: samples, ellipses and marks. @param {PlaceOrbit} orbit @param {number[]} pulses_s @param {{measured: string, nominal: string}} [called] */
export function orbitFigure(orbit, pulses_s, called = { measured: "1× measured", nominal: "as nominal" }) {
  const { path, ellipse, nominal, estimated, location, unit } = orbit;
  const reach = Math.max(...[ellipse, nominal, estimated].map((one) => one?.semi_major ?? 0), ...(path ? [...path.y, ...path.z].map(Math.abs) : []), 1e-12);
  const [factor] = shownIn(printed(unit));
  const rim = roundUp(reach * factor) / factor;
  const scale = REACH / rim;
  const oval = (/** @type {Ellipse | null} */ one, /** @type {string} */ kind) =>
    one && svg("ellipse", { class: kind, rx: one.semi_major * scale, ry: one.semi_minor * scale, transform: `rotate(${-one.tilt_deg})` });
  const points = path ? path.y.map((y, at) => `${(y * scale).toFixed(1)},${(-path.z[at] * scale).toFixed(1)}`).join(" ") : "";
  const said = ellipse ? `${figure(2 * ellipse.semi_major * factor)} × ${quantity(2 * ellipse.semi_minor, printed(unit))} pp at running speed, ${ellipse.precession ?? ellipse.sense}` : "no ellipse";
  const keys = [path && ["path", "samples"], ellipse && ["measured", called.measured], nominal && ["nominal", called.nominal], estimated && ["estimated", "as estimated"], path && pulses_s.length && ["pulse", "keyphasor"]];
  return html(
    "figure",
    {},
    html("figcaption", {}, location, html("small", { class: "number" }, ` ${said}`)),
    plane(
      `orbit at the ${location}: ${said}`,
      quantity(rim / 2, printed(unit)),
      svg("polyline", { class: "path", points }),
      oval(nominal, "nominal"),
      oval(estimated, "estimated"),
      oval(ellipse, "measured"),
      ...marked(orbit, pulses_s).map(([y, z]) => svg("circle", { class: "pulse", cx: y * scale, cy: -z * scale, r: 3 })),
    ),
    html("p", { class: "keys" }, ...keys.filter(Boolean).map((key) => html("span", { class: `key ${/** @type {string[]} */ (key)[0]}` }, /** @type {string[]} */ (key)[1]))),
  );
}

/** Orbits of a window: samples, the ellipse at running speed, theory, and the keyphasor's mark. */
class OrbitPlot extends MachineElement {
  refreshS = 15;
  message = html("p", { class: "note" });

  async ask() {
    const found = /** @type {Orbits} */ (await this.askFor("orbits", `revolutions=${REVOLUTIONS}`));
    const drawn = found.orbits.filter((one) => one.ellipse || one.path);
    const reasons = [...new Set([this.windowText(found), found.reason, found.path_reason])].filter(Boolean).join("; ");
    this.replaceChildren(html("h2", {}, "Orbits"), html("div", { class: "charts" }, ...drawn.map((one) => orbitFigure(one, found.pulses_s))), html("p", { class: "note" }, reasons));
  }
}

customElements.define("orbit-plot", OrbitPlot);
