import { quantity, stretch } from "../monitor/figures.js";
import { html, svg } from "../elements/markup.js";
import { angleOf } from "../machine/machine-file.js";
import { plane, REACH, roundUp } from "./plane.js";
import { choiceOf, offered, SamplePlot } from "./sample-plot.js";
import "../elements/line-chart.js";

/** @import { VectorSeries as Vectors } from "../monitor/records.d.ts" */

const rpm = (/** @type {number | null} */ speed) => Math.abs((speed ?? 0) * 30) / Math.PI;

/** Amplitude and phase of 1x over speed (Bode) and in the polar plane. @extends {SamplePlot<Vectors>} */
class VectorPlot extends SamplePlot {
  route = "vectors";
  live = "windows of the history";
  refreshS = 60; // hundreds of reports are read
  #order = choiceOf("Order", () => this.load());

  choices() {
    offered(this.#order, [["1", "1×"], ["2", "2×"]]);
    return [this.channel, this.#order];
  }

  /** @returns {[string, string][]} */
  asked() {
    return [["channel", this.channel.value], ["order", this.#order.value]];
  }

  /** @param {Vectors} found */
  draw(found) {
    const shown = found.channels[0];
    this.body.hidden = !shown;
    if (!shown) return "";
    const steady = Boolean(found.steady);
    const order = found.times_ns.map((_, at) => at);
    if (!steady) order.sort((one, other) => rpm(found.speeds_rad_s[one]) - rpm(found.speeds_rad_s[other]));
    const x = order.map((at) => (steady ? found.times_ns[at] / 1e9 : rpm(found.speeds_rad_s[at])));
    const over = steady ? "time" : "speed";
    const drawn = { x, marks: [], time: steady, xUnit: "speed, rpm" };
    const values = (/** @type {(number | null)[]} */ of) => order.map((at) => of[at]);
    this.lines([
      {
        name: `Amplitude over ${over}`,
        said: `amplitude of ${shown.channel} over ${over}`,
        drawing: { ...drawn, lines: [{ label: "amplitude", values: values(shown.amplitude), dots: true }], include: [0], unit: shown.unit, height: 220 },
      },
      {
        name: `Phase lag over ${over}`,
        said: `phase lag of ${shown.channel} over ${over}`,
        drawing: { ...drawn, lines: [{ label: "lag", values: values(shown.phase_lag_deg), dots: true }], cut: [0, 360, 90], unit: "phase lag, °, downwards", height: 220 },
      },
    ]);
    const charts = /** @type {Element} */ (this.body.firstElementChild);
    charts.querySelector(".polar")?.remove();
    charts.append(html("figure", { class: "polar" }, html("figcaption", {}, "In their plane"), this.#polar(found)));
    const each = found.revolutions ? `of ${found.revolutions} revolutions each` : "of a window each";
    const which = `${found.order}× of ${shown.channel}, ${found.source}, ${found.times_ns.length} vectors ${each}, ${stretch(found.times_ns[0], found.times_ns[found.times_ns.length - 1])}`;
    return steady ? `${which}; ${found.steady}, so amplitude and phase are shown over time` : which;
  }

  /** Polar plot with angles as on the machine: 0° at the sensor, the lag counted against the rotation. @param {Vectors} found */
  #polar(found) {
    const [shown] = found.channels;
    const sensor = this.sensors.find((one) => one.name === shown.channel);
    const zero = sensor ? (angleOf(sensor) ?? 0) : 0;
    const reach = roundUp(Math.max(...shown.amplitude.map((one) => one ?? 0), 1e-12));
    const points = shown.amplitude.flatMap((length, at) => {
      const angle = ((zero - Math.sign(found.speeds_rad_s[at] || 1) * (shown.phase_lag_deg[at] ?? 0)) * Math.PI) / 180;
      return length === null ? [] : [[(REACH * length * Math.cos(angle)) / reach, (-REACH * length * Math.sin(angle)) / reach]];
    });
    const [first, last] = [points[0], points[points.length - 1]];
    const said = `from ${rpm(found.speeds_rad_s[0]).toFixed(0)} to ${rpm(found.speeds_rad_s[found.speeds_rad_s.length - 1]).toFixed(0)} rpm`;
    const at = (zero * Math.PI) / 180;
    return html(
      "div",
      {},
      plane(
        `vectors of ${shown.channel}, ${said}`,
        quantity(reach / 2, shown.unit),
        svg("circle", { class: "grid ring", r: REACH }),
        svg("circle", { class: "grid ring", r: REACH / 2 }),
        svg("line", { class: "zero", x2: REACH * Math.cos(at), y2: -REACH * Math.sin(at) }),
        svg("polyline", { class: "path", points: points.map((one) => one.map((each) => each.toFixed(1)).join(",")).join(" ") }),
        ...points.map(([y, z]) => svg("circle", { class: "point", cx: y, cy: z, r: 1.3 })),
        first && svg("circle", { class: "first", cx: first[0], cy: first[1], r: 3.5 }),
        last && svg("circle", { class: "pulse", cx: last[0], cy: last[1], r: 3.5 }),
      ),
      html("p", { class: "keys" }, html("span", { class: "key path" }, "vectors in their order"), html("span", { class: "key first" }, "first"), html("span", { class: "key pulse" }, "last"), html("span", { class: "key zero" }, "0° at the sensor, lag against the rotation")),
    );
  }
}

customElements.define("vector-plot", VectorPlot);
