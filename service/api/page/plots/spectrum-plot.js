import { figure, printed } from "../monitor/figures.js";
import { html } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import "../elements/line-chart.js";

const [REFRESH_S, ORDERS] = [15, 5];

/** @typedef {import("../monitor/records.js").Spectra} Spectra */

/** One channel's spectrum beside its theory, with the orders. @param {Spectra} found @param {import("../monitor/records.js").Density} shown @returns {import("../elements/line-chart.js").Drawing} */
export function spectrumDrawing(found, shown) {
  const turning = found.rotation_hz;
  const last = found.frequencies_hz[found.frequencies_hz.length - 1];
  const orders = turning ? Array.from({ length: ORDERS }, (_, at) => at + 1).filter((order) => order * turning <= last) : [];
  /** @type {import("../elements/line-chart.js").Line[]} */
  const lines = [{ label: "measured", values: shown.measured }];
  if (shown.nominal) lines.push({ label: "as nominal", values: shown.nominal, colour: "nominal", dash: [6, 4] });
  if (shown.estimated) lines.push({ label: "as estimated", values: shown.estimated, colour: "estimated", width: 2 });
  return {
    x: found.frequencies_hz,
    lines,
    marks: orders.map((order) => ({ at: order * /** @type {number} */ (turning), axis: "x", colour: "ink-2", text: `${order}×`, dash: [2, 3] })),
    time: false,
    log: true,
    unit: printed(shown.unit),
    xUnit: "frequency, Hz",
    shaded: found.left_out_hz ? [{ from: found.left_out_hz[0], to: found.left_out_hz[1] }] : [],
    height: 280,
  };
}

/** Power spectral densities of a window beside theory, with the orders of the running speed. */
class SpectrumPlot extends MachineElement {
  #message = html("p", { class: "note" });
  #choice = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Channel", change: () => this.load() }));
  #chart = /** @type {any} */ (html("line-chart", { role: "img", "aria-label": "spectrum" }));

  connectedCallback() {
    super.connectedCallback();
    this.replaceChildren(html("div", { class: "tools" }, html("h2", {}, "Spectrum"), this.#choice), this.#chart, this.#message);
    this.keepLoading(REFRESH_S);
  }

  async ask() {
    this.#draw(await this.askFor("spectra"));
  }

  /** @param {string} why */
  refused(why) {
    this.#message.textContent = why;
  }

  /** @param {Spectra} found */
  #draw(found) {
    const names = found.densities.map((one) => one.channel);
    if (this.#choice.options.length !== names.length) this.#choice.replaceChildren(...names.map((name) => html("option", { value: name }, name)));
    const shown = found.densities.find((one) => one.channel === this.#choice.value) ?? found.densities[0];
    this.#chart.hidden = this.#choice.hidden = !shown;
    const theory = found.theory;
    // Whoever looks for 1× has to be told where it is.
    const once = shown && found.left_out_hz ? "1× is taken out (shaded: where some of it may be left); it is among the vibration levels" : "";
    const others = shown || this.recorded ? "" : "the waterfall below shows spectra of every channel";
    this.#message.textContent = [this.windowText(found), once, found.reason, others, theory.nominal_reason || theory.estimated_reason].filter(Boolean).join("; ");
    if (!shown) return;
    this.#chart.setAttribute("aria-label", `spectrum of ${shown.channel}, rms ${figure(shown.rms)}`);
    this.#chart.draw(spectrumDrawing(found, shown));
  }
}

customElements.define("spectrum-plot", SpectrumPlot);
