import { html } from "../elements/markup.js";
import { monitor } from "../monitor/monitor.js";
import { STATES, stands, urgency } from "../monitor/states.js";
import "../alarms/alarm-strip.js";
import "./machine-tile.js";

/** @typedef {import("../monitor/records.js").Health} Health */

/** Every machine as a tile, the most urgent first; those without data and without an alarm apart. */
class PlantView extends HTMLElement {
  #gone = new AbortController();
  /** @type {Map<string, Element>} */
  #tiles = new Map();
  #due = false;
  #search = html("input", { type: "search", placeholder: "Search machines", "aria-label": "Search machines", input: () => this.#soon() });
  #filter = html("select", { "aria-label": "State", change: () => this.#soon() });
  #found = html("div", { class: "tiles" });
  #silent = html("div", { class: "tiles" });
  #summary = html("summary");
  #apart = html("details", {}, this.#summary, this.#silent);
  #none = html("p", { class: "note", hidden: true });

  connectedCallback() {
    this.#gone = new AbortController();
    this.replaceChildren(
      html("alarm-strip"),
      html("div", { class: "tools" }, html("h1", {}, "Plant"), this.#search, this.#filter),
      this.#none,
      this.#found,
      this.#apart,
    );
    monitor.addEventListener("health", () => this.#soon(), { signal: this.#gone.signal });
    this.#arrange();
  }

  disconnectedCallback() {
    this.#gone.abort();
  }

  /** Once a frame, however many machines are heard of. */
  #soon() {
    if (this.#due) return;
    this.#due = true;
    requestAnimationFrame(() => {
      this.#due = false;
      this.#arrange();
    });
  }

  #arrange() {
    const all = [...monitor.machines].map(([place, { health }]) => ({ place, health }));
    this.#count(all.map((one) => one.health));
    const words = /** @type {HTMLInputElement} */ (this.#search).value.toLowerCase().split(/\s+/);
    const state = /** @type {HTMLSelectElement} */ (this.#filter).value;
    const chosen = all
      .filter(({ place, health }) => words.every((word) => place.toLowerCase().includes(word)) && (!state || health.state === state || (state === "no-data" && health.stream.silent)))
      .sort((one, other) => urgency(one.health.state) - urgency(other.health.state) || one.place.localeCompare(other.place));
    const apart = (/** @type {Health} */ health) => (health.state === "no-data" || health.stream.data_age_s === null) && !health.alarms.some((one) => stands(one) && one.name !== "stream-lost");
    const silent = chosen.filter(({ health }) => apart(health));
    this.#place(this.#found, chosen.filter(({ health }) => !apart(health)));
    this.#place(this.#silent, silent);
    this.#summary.textContent = `${silent.length} without data`;
    this.#apart.hidden = !silent.length;
    this.#none.hidden = chosen.length > 0;
    this.#none.textContent = all.length ? "No machine is like that." : "Nothing has been heard of any machine yet.";
  }

  /** Elements move only where the order has changed: what has the focus keeps it. @param {Element} where @param {{place: string}[]} machines */
  #place(where, machines) {
    const tiles = machines.map(({ place }) => {
      const made = this.#tiles.get(place) ?? html("machine-tile", { place });
      this.#tiles.set(place, made);
      return made;
    });
    for (const old of [...where.children]) if (!tiles.includes(old)) old.remove();
    tiles.forEach((tile, at) => where.children[at] === tile || where.insertBefore(tile, where.children[at] ?? null));
  }

  /** How many are in each state; states that none is in are not offered. @param {Health[]} healths */
  #count(healths) {
    const chosen = /** @type {HTMLSelectElement} */ (this.#filter).value;
    const count = (/** @type {string} */ state) => healths.filter((one) => one.state === state || (state === "no-data" && one.stream.silent)).length;
    const options = [["", `all ${healths.length} machines`], ...Object.entries(STATES).flatMap(([state, text]) => (count(state) || state === chosen ? [[state, `${text} (${count(state)})`]] : []))];
    const said = options.map(([, text]) => text).join();
    if (this.#filter.dataset.said === said) return;
    this.#filter.dataset.said = said;
    this.#filter.replaceChildren(...options.map(([value, text]) => html("option", { value, selected: value === chosen }, text)));
  }
}

customElements.define("plant-view", PlantView);
