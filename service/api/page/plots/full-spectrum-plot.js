import { stretch } from "../monitor/figures.js";
import { SamplePlot } from "./sample-plot.js";
import "../elements/line-chart.js";

const ORDERS = 5;

/** @import { FullSpectrumSnapshot as FullSpectra } from "../monitor/records.d.ts" */

/** Full spectra, forward and reverse, at each location with two displacements. @extends {SamplePlot<FullSpectra>} */
class FullSpectrumPlot extends SamplePlot {
  route = "full-spectra";

  /** @param {FullSpectra} found */
  draw(found) {
    const known = found.speed_rad_s !== null;
    const turns = Math.abs(found.speed_rad_s ?? 0) / (2 * Math.PI);
    const last = found.frequencies_hz[found.frequencies_hz.length - 1] ?? 0;
    const cut = turns && ORDERS * turns < last; // on a slow machine the orders would be too close to distinguish
    const shown = found.frequencies_hz.flatMap((line, at) => (cut && Math.abs(line) > ORDERS * turns ? [] : [at]));
    const orders = [-2, -1, 1, 2].filter((order) => turns && Math.abs(order) * turns < last);
    /** @type {import("../elements/line-chart.js").Mark[]} */
    const marks = [{ at: 0, axis: "x", colour: "ink-2" }, ...orders.map((order) => ({ at: order * turns, axis: /** @type {"x"} */ ("x"), colour: "ink-2", text: `${order < 0 ? "−" : ""}${Math.abs(order)}×`, dash: [2, 3] }))];
    this.lines(
      found.places.map((one) => ({
        name: one.location,
        more: one.channels.join(" and "),
        said: `full spectrum at the ${one.location}`,
        drawing: {
          x: shown.map((at) => found.frequencies_hz[at]),
          lines: [{ label: "diameter", values: shown.map((at) => one.values[at]) }],
          marks,
          time: false,
          include: [0],
          unit: one.unit,
          xUnit: known ? "← reverse     frequency, Hz     forward →" : "← z to y     frequency, Hz     y to z →",
          height: 230,
        },
      })),
    );
    return found.start_ns && found.end_ns ? `${found.source}, ${stretch(found.start_ns, found.end_ns)}, ${found.averages} averages${cut ? `, up to ${ORDERS}×` : ""}: circles that add up to the motion of the shaft` : "";
  }
}

customElements.define("full-spectrum-plot", FullSpectrumPlot);
