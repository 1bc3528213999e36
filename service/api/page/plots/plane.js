/** The plane across the shaft, y to the right and z up, of equal scale: for orbits, polar plots and centrelines. */

import { svg } from "../elements/markup.js";

export const SIZE = 220;
/** Half of the drawn part of `SIZE`. */
export const REACH = 0.46 * SIZE;

/** Round a length up to 1, 2, 5 or 10 times a power of ten. @param {number} length */
export function roundUp(length) {
  const power = 10 ** Math.floor(Math.log10(length));
  return power * (/** @type {number} */ ([1, 2, 5, 10].find((each) => each * power >= length * (1 - 1e-9))));
}

/**
 * Children on a grid of four by four fields, their lengths in pixels.
 * @param {string} said description for screen readers
 * @param {string} field size of a field, with its unit
 * @param {...(Node | null | false)} children
 */
export function plane(said, field, ...children) {
  const half = SIZE / 2;
  const grid = [-1, -0.5, 0, 0.5, 1].flatMap((each) => {
    const at = each * REACH;
    return [svg("line", { class: "grid", x1: -half, x2: half, y1: at, y2: at }), svg("line", { class: "grid", y1: -half, y2: half, x1: at, x2: at })];
  });
  return svg(
    "svg",
    { viewBox: `${-half} ${-half} ${SIZE} ${SIZE}`, role: "img", "aria-label": said, class: "orbit" },
    ...grid,
    ...children,
    svg("text", { x: half - 4, y: -4, "text-anchor": "end" }, "y"),
    svg("text", { x: 4, y: -half + 12 }, "z"),
    svg("text", { x: REACH - 2, y: half - 4, "text-anchor": "end" }, `grid ${field}`),
  );
}
