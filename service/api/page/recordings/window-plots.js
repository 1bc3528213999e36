import { html, lay } from "../elements/markup.js";
import "../plots/plot-fold.js";

const REST_MS = 400;
const FOLDED = [
  ["orbit-plot", "Orbits of this window"],
  ["spectrum-plot", "Spectrum of this window"],
  ["waveform-plot", "Waveform at its end"],
  ["full-spectrum-plot", "Full spectrum at its end"],
  ["correlation-plot", "Correlations and residuals of the equations"],
];

/** The plots of a live machine for a window of a replay, from the replay's samples: `<window-plots place replay>`. */
class WindowPlots extends HTMLElement {
  #folds = /** @type {any[]} */ ([]);
  #timer = 0;
  #shown = "";

  connectedCallback() {
    this.#folds = FOLDED.map(([shows, heading]) => html("plot-fold", { place: this.getAttribute("place"), shows: `plots/${shows}`, heading }));
    lay(this, ...this.#folds);
  }

  disconnectedCallback() {
    clearTimeout(this.#timer);
  }

  /**
   * Show the window that ends at a time, once the user stops moving on.
   * @param {number} end_ns
   * @param {import("../monitor/records.d.ts").Health} [health] as it was told then
   */
  stand(end_ns, health) {
    const recorded = new URLSearchParams({ replay: this.getAttribute("replay") ?? "", until_ns: String(Math.round(end_ns)) }).toString();
    if (recorded === this.#shown) return;
    this.#shown = recorded;
    clearTimeout(this.#timer);
    this.#timer = setTimeout(() => {
      for (const fold of this.#folds) {
        if (health) fold.feed(health);
        fold.setAttribute("recorded", recorded);
      }
    }, REST_MS);
  }
}

customElements.define("window-plots", WindowPlots);
