import { html } from "../elements/markup.js";
import { monitor } from "../monitor/monitor.js";

/**
 * A folded element: `<plot-fold place shows="plots/waveform-plot" heading>`, initially unfolded with `open`. Its content is loaded when it is opened, and
 * requests nothing once it is closed again. `recorded` is passed on, also when it changes.
 */
class PlotFold extends HTMLElement {
  static observedAttributes = ["recorded"];
  #inside = html("div");
  /** @type {import("../monitor/records.d.ts").Health | null} */
  #fed = null;

  connectedCallback() {
    const shows = this.getAttribute("shows") ?? "";
    const toggled = async (/** @type {{target: HTMLDetailsElement}} */ { target }) => {
      if (!target.open) return this.#inside.replaceChildren();
      try {
        await import(`../${shows}.js`);
        if (target.open) this.#fill(shows.slice(shows.indexOf("/") + 1));
      } catch {
        this.#inside.replaceChildren(html("p", { class: "note" }, monitor.unloaded));
      }
    };
    this.replaceChildren(html("details", { toggle: toggled, open: this.hasAttribute("open") }, html("summary", {}, html("h2", {}, this.getAttribute("heading"))), this.#inside));
  }

  /** @param {string} _name @param {string | null} _old @param {string | null} recorded */
  attributeChangedCallback(_name, _old, recorded) {
    if (recorded !== null) this.#inside.firstElementChild?.setAttribute("recorded", recorded);
  }

  /** Show this health instead of live data, see `MachineElement`. @param {import("../monitor/records.d.ts").Health} health */
  feed(health) {
    this.#fed = health;
    /** @type {any} */ (this.#inside.firstElementChild)?.feed?.(health);
  }

  /** @param {string} tag */
  #fill(tag) {
    const [place, hours, recorded] = ["place", "hours", "recorded"].map((name) => this.getAttribute(name));
    const made = /** @type {any} */ (html(tag, { place, hours, recorded }));
    if (this.#fed) made.feed?.(this.#fed);
    this.#inside.replaceChildren(made);
  }
}

customElements.define("plot-fold", PlotFold);
