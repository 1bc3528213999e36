import { printed } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { orbitFigure } from "../plots/orbit-plot.js";
import { spectrumDrawing } from "../plots/spectrum-plot.js";
import "../elements/line-chart.js";

/** @typedef {import("../monitor/records.js").Picture} Picture */

/** Orbits and spectra of two windows, one over the other. */
class BeforeAfter extends HTMLElement {
  #choice = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Channel of the spectrum", change: () => this.#spectrum() }));
  #chart = /** @type {any} */ (html("line-chart", { role: "img" }));
  /** @type {Picture | null} */
  #before = null;
  /** @type {Picture | null} */
  #after = null;

  /** @param {Picture | null} before @param {Picture} after */
  show(before, after) {
    [this.#before, this.#after] = [before, after];
    const orbits = after.orbits.orbits.filter((one) => one.ellipse);
    const channels = after.spectra.densities.map((one) => one.channel);
    this.#choice.replaceChildren(...channels.map((name) => html("option", { value: name }, name)));
    lay(
      this,
      html(
        "div",
        { class: "charts" },
        ...orbits.map((one) => {
          const was = before?.orbits.orbits.find((other) => other.location === one.location)?.ellipse ?? null;
          return orbitFigure({ ...one, nominal: was, estimated: null, path: null }, [], { measured: "after", nominal: "before" });
        }),
        channels.length > 0 && html("figure", {}, html("figcaption", {}, "Spectrum of ", this.#choice), this.#chart),
      ),
    );
    if (!orbits.length && !channels.length) lay(this, html("p", { class: "note" }, [after.orbits.reason, after.spectra.reason].filter(Boolean).join("; ")));
  }

  connectedCallback() {
    this.#spectrum();
  }

  #spectrum() {
    const name = this.#choice.value;
    const now = this.#after?.spectra.densities.find((one) => one.channel === name);
    if (!this.#after || !now) return;
    const was = this.#before?.spectra.densities.find((one) => one.channel === name);
    const drawing = spectrumDrawing(this.#after.spectra, now);
    const same = was && this.#before?.spectra.frequencies_hz.length === drawing.x.length;
    /** @type {import("../elements/line-chart.js").Line[]} */
    const lines = [{ label: "after", values: now.measured, colour: "estimated", width: 2 }];
    if (same) lines.unshift({ label: "before", values: was.measured, colour: "nominal", dash: [6, 4], width: 1.5 });
    this.#chart.setAttribute("aria-label", `spectrum of ${name} before and after, ${printed(now.unit)}`);
    this.#chart.draw({ ...drawing, lines, height: 240 });
  }
}

customElements.define("before-after", BeforeAfter);
