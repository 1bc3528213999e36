import { html } from "../elements/markup.js";
import "../elements/line-chart.js";

/** @import { Parameter } from "../monitor/records.d.ts" */

const [REACH, POINTS] = [4.5, 60]; // range on either side in standard errors, number of points

/** Likelihood of values of a parameter given one reading, 1 at the maximum: a normal curve, as assumed by the interval. @param {Parameter | undefined} read @param {number[]} at */
function likelihood(read, at) {
  return at.map((value) => {
    if (!read) return null;
    const z = (value / 100 - Number(read.relative_change)) / Number(read.standard_error);
    return Math.abs(z) > REACH ? null : Math.exp((-z * z) / 2);
  });
}

/** A parameter as it was read before and after a change. @param {string} text @param {Parameter | undefined} before @param {Parameter} after */
export function curve(text, before, after) {
  const at = [before, after].flatMap((read) => (read ? Array.from({ length: 2 * POINTS + 1 }, (_, step) => 100 * (Number(read.relative_change) + (REACH * (step / POINTS - 1)) * Number(read.standard_error))) : []));
  const x = [...new Set([0, ...at])].sort((one, other) => one - other);
  const chart = /** @type {any} */ (html("line-chart", { role: "img", "aria-label": `likelihood of the change of ${text}, before and after` }));
  const lines = [{ label: "after", values: likelihood(after, x), colour: "estimated", width: 2 }];
  if (before) lines.unshift(/** @type {any} */ ({ label: "before", values: likelihood(before, x), colour: "nominal", dash: [6, 4], width: 2 }));
  queueMicrotask(() => chart.draw({ x, lines, marks: [{ at: 0, axis: "x", colour: "ink-2", text: "nominal", dash: [2, 3] }], time: false, include: [0, 1], unit: "likelihood", xUnit: "change from nominal, %", height: 200 }));
  return html("figure", {}, html("figcaption", {}, `${text}: how likely each change is, relative to the likeliest`), chart);
}
