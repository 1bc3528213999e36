import { figure, printed, stretch } from "../monitor/figures.js";
import { html } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import "../elements/line-chart.js";

const ORDERS = 5;

/** @import { SpectrumSnapshot as Spectra, WaterfallSnapshot as Waterfall } from "../monitor/records.d.ts" */

/** Common parts of spectra: axes and orders. @param {number[]} lines @param {number | null} turning Hz @param {string} unit */
function frame(lines, turning, unit) {
  const orders = turning ? Array.from({ length: ORDERS }, (_, at) => at + 1).filter((order) => order * turning <= lines[lines.length - 1]) : [];
  return {
    x: lines,
    marks: orders.map((order) => ({ at: order * /** @type {number} */ (turning), axis: /** @type {const} */ ("x"), colour: "ink-2", text: `${order}×`, dash: [2, 3] })),
    time: false,
    log: true,
    unit: printed(unit),
    xUnit: "frequency, Hz",
    height: 280,
  };
}

/** One channel's spectrum with theory and orders. @param {Spectra} found @param {import("../monitor/records.d.ts").ChannelDensity} shown @returns {import("../elements/line-chart.js").Drawing} */
export function spectrumDrawing(found, shown) {
  /** @type {import("../elements/line-chart.js").Line[]} */
  const lines = [{ label: "measured", values: shown.measured }];
  if (shown.nominal) lines.push({ label: "as nominal", values: shown.nominal, colour: "nominal", dash: [6, 4] });
  if (shown.estimated) lines.push({ label: "as estimated", values: shown.estimated, colour: "estimated", width: 2 });
  return {
    ...frame(found.frequencies_hz, found.rotation_hz, shown.unit),
    lines,
    shaded: found.left_out_hz ? [{ from: found.left_out_hz[0], to: found.left_out_hz[1] }] : [],
  };
}

/** Power spectral densities of a window with theory and the orders of running speed. */
class SpectrumPlot extends MachineElement {
  refreshS = 15;
  message = html("p", { class: "note" });
  #choice = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Channel", change: () => this.load() }));
  #chart = /** @type {any} */ (html("line-chart", { role: "img", "aria-label": "spectrum" }));

  connectedCallback() {
    super.connectedCallback();
    this.replaceChildren(html("div", { class: "tools" }, html("h2", {}, "Spectrum"), this.#choice), this.#chart, this.message);
  }

  async ask() {
    const found = /** @type {Spectra} */ (await this.askFor("spectra"));
    const held = found.densities.map((one) => one.channel);
    // For channels of which only levels are watched, there is no spectrum of the window, but there are newest samples.
    const there = this.recorded || found.filled < 1 ? [] : ((await this.machineFile())?.sensors ?? []);
    const others = there.filter((one) => one.quantity !== "shaft_angle" && !held.includes(one.name)).map((one) => one.name);
    const names = [...held, ...others];
    if (this.#choice.options.length !== names.length) this.#choice.replaceChildren(...names.map((name) => html("option", { value: name }, name)));
    const name = this.#choice.value;
    if (others.includes(name)) this.#drawNewest(await this.askFor("waterfalls", new URLSearchParams({ channel: name, over: "time" }).toString()));
    else this.#draw(found);
  }

  /** Amplitude spectrum of the newest samples. @param {Waterfall} found */
  #drawNewest({ channel, rows, frequencies_hz: lines, unit, start_ns, end_ns }) {
    this.#chart.hidden = this.#choice.hidden = !rows.length;
    if (!rows.length || !start_ns || !end_ns) return this.refused(`No samples of ${channel} are there.`);
    const values = lines.map((_, at) => Math.sqrt(rows.reduce((sum, row) => sum + (row.values[at] ?? 0) ** 2, 0) / rows.length));
    const speeds = rows.flatMap((row) => row.speed_rad_s ?? []);
    const turning = speeds.length ? Math.abs(speeds.reduce((sum, one) => sum + one, 0)) / speeds.length / (2 * Math.PI) : 0;
    this.#chart.setAttribute("aria-label", `spectrum of ${channel}`);
    this.#chart.draw({ ...frame(lines, turning, unit), lines: [{ label: "measured", values }], shaded: [] });
    this.message.textContent = `Amplitudes in the newest samples, ${stretch(start_ns, end_ns)}, mean of ${rows.length} spectra; lines ${figure(lines[1] - lines[0])} Hz apart`;
  }

  /** @param {Spectra} found */
  #draw(found) {
    const shown = found.densities.find((one) => one.channel === this.#choice.value) ?? found.densities[0];
    this.#chart.hidden = this.#choice.hidden = !shown;
    const theory = found.theory;
    // State where 1× is, because it is removed from these spectra.
    const once = shown && found.left_out_hz ? "1× is taken out (shaded: where some of it may be left); it is among the vibration levels" : "";
    this.message.textContent = [...new Set([this.windowText(found), once, found.reason, theory.nominal_reason || theory.estimated_reason])].filter(Boolean).join("; ");
    if (!shown) return;
    this.#chart.setAttribute("aria-label", `spectrum of ${shown.channel}, rms ${figure(shown.rms)}`);
    this.#chart.draw(spectrumDrawing(found, shown));
  }
}

customElements.define("spectrum-plot", SpectrumPlot);
