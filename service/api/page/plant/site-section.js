import { arrange, html, lay } from "../elements/markup.js";
import { ABNORMAL, urgency } from "../monitor/states.js";
import "../elements/state-mark.js";
import "./machine-tile.js";

const KEPT = "rotorwatch.folded";

/** Sites whose machines are folded away in this browser. @returns {string[]} */
const folded = () => JSON.parse(localStorage.getItem(KEPT) ?? "[]");

/** @typedef {{place: string, health: import("../monitor/records.d.ts").Health}} Machine */

/** Machines of one site under a heading that can be folded: `<site-section site="demo">`; the worst state stays visible. */
export class SiteSection extends HTMLElement {
  #summary = html("summary");
  #tiles = html("div", { class: "tiles" });
  #details = /** @type {HTMLDetailsElement} */ (html("details", { toggle: () => this.#keep() }, this.#summary, this.#tiles));
  /** @type {Machine[]} */
  #machines = [];
  /** @type {Map<string, HTMLElement>} */
  #made = new Map();

  get site() {
    return this.getAttribute("site") ?? "";
  }

  connectedCallback() {
    this.#details.open = !folded().includes(this.site);
    this.replaceChildren(this.#details);
  }

  /** @param {Machine[]} machines in the order they are to be in @param {number} silent how many others have no data, and are shown elsewhere */
  show(machines, silent) {
    this.#machines = machines;
    const worst = machines.map(({ health }) => health.state).sort((one, other) => urgency(one) - urgency(other))[0];
    const abnormal = machines.filter(({ health }) => ABNORMAL.has(health.state)).length;
    const count = machines.length + silent;
    const said = [worst, `${count} ${count === 1 ? "machine" : "machines"}${abnormal ? `, ${abnormal} abnormal` : ""}${silent ? `, ${silent} without data` : ""}`];
    if (said.join() !== this.#summary.dataset.said) {
      this.#summary.dataset.said = said.join();
      lay(this.#summary, html("h2", {}, this.site), html("state-mark", { state: said[0] }), html("span", { class: "note" }, said[1]));
    }
    this.#place();
  }

  /** Folded machines have no elements. */
  #place() {
    const places = this.#details.open ? this.#machines.map(({ place }) => place) : [];
    arrange(this.#tiles, places, this.#made, (place) => html("machine-tile", { place }));
  }

  #keep() {
    const others = folded().filter((site) => site !== this.site);
    localStorage.setItem(KEPT, JSON.stringify(this.#details.open ? others : [...others, this.site]));
    this.#place();
  }
}

customElements.define("site-section", SiteSection);
