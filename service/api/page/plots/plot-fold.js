import { html } from "../elements/markup.js";

/**
 * Something that is not always needed, folded: `<plot-fold place shows="plots/waveform-plot" heading>`, with `open` not at first. It is loaded when it is
 * opened, and asks for nothing once it is closed again.
 */
class PlotFold extends HTMLElement {
  connectedCallback() {
    const [shows, place] = [this.getAttribute("shows") ?? "", this.getAttribute("place")];
    const inside = html("div");
    const toggled = async (/** @type {{target: HTMLDetailsElement}} */ { target }) => {
      if (!target.open) return inside.replaceChildren();
      try {
        await import(`../${shows}.js`);
        if (target.open) inside.replaceChildren(html(shows.slice(shows.indexOf("/") + 1), { place, hours: this.getAttribute("hours") }));
      } catch {
        inside.replaceChildren(html("p", { class: "note" }, "The monitor serves another page by now: load this one again."));
      }
    };
    this.replaceChildren(html("details", { toggle: toggled, open: this.hasAttribute("open") }, html("summary", {}, html("h2", {}, this.getAttribute("heading"))), inside));
  }
}

customElements.define("plot-fold", PlotFold);
