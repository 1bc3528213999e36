import { arrange, html } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { monitor } from "../monitor/monitor.js";
import { STATES, stands, urgency } from "../monitor/states.js";
import "../alarms/alarm-strip.js";
import "./site-section.js";

const KEPT = "rotorwatch.order";
const byName = new Intl.Collator(undefined, { numeric: true }).compare;

/** @import { Health } from "../monitor/records.d.ts" */
/** @import { Machine } from "./site-section.js" */

/** Age of the newest data in whole minutes, so that machines with continuous data keep their places. @param {Machine} machine */
const minutes = ({ place }) => Math.floor((monitor.dataAge(place) ?? Infinity) / 60);

/** Orders of machines; equal ones are ordered by name. @type {Record<string, (one: Machine, other: Machine) => number>} */
const ORDERS = {
  "most urgent first": (one, other) => urgency(one.health.state) - urgency(other.health.state),
  "by name": () => 0,
  "oldest data first": (one, other) => (minutes(one) === minutes(other) ? 0 : minutes(other) - minutes(one)),
};

/** Whether the only thing to report of a machine is that it has no data. @param {Health} health */
const apart = (health) => (health.state === "no-data" || health.stream.data_age_s === null) && !health.alarms.some((one) => stands(one) && one.name !== "stream-lost");

/** Tiles of all machines, by site; machines without data and without an alarm are shown apart. */
class PlantView extends LiveElement {
  /** @type {Map<string, HTMLElement>} */
  #sections = new Map();
  /** @type {Map<string, HTMLElement>} */
  #tiles = new Map();
  #search = /** @type {HTMLInputElement} */ (html("input", { type: "search", placeholder: "Search machines", "aria-label": "Search machines", input: () => this.#arrange() }));
  #filter = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "State", change: () => this.#arrange() }));
  #order = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Order", change: () => this.#reorder() }, ...Object.keys(ORDERS).map((each) => html("option", { value: each, selected: each === localStorage.getItem(KEPT) }, each))));
  #sites = html("div");
  #silent = html("div", { class: "tiles" });
  #summary = html("summary");
  #apart = /** @type {HTMLDetailsElement} */ (html("details", { class: "apart" }, this.#summary, this.#silent));
  #none = html("p", { class: "note", hidden: true });

  connectedCallback() {
    super.connectedCallback();
    this.replaceChildren(
      html("alarm-strip"),
      html("div", { class: "tools" }, html("h1", {}, "Plant"), this.#search, this.#filter, this.#order),
      this.#none,
      this.#sites,
      this.#apart,
    );
    this.follow("health", () => this.#arrange());
    this.#arrange();
  }

  #reorder() {
    localStorage.setItem(KEPT, this.#order.value);
    this.#arrange();
  }

  #arrange() {
    const all = [...monitor.machines].map(([place, { health }]) => ({ place, health }));
    this.#count(all.map((one) => one.health));
    const words = this.#search.value.toLowerCase().split(/\s+/);
    const state = this.#filter.value;
    const first = ORDERS[this.#order.value];
    const chosen = all
      .filter(({ place, health }) => words.every((word) => place.toLowerCase().includes(word)) && (!state || health.state === state || (state === "no-data" && health.stream.silent)))
      .sort((one, other) => first(one, other) || byName(one.place, other.place));
    /** @type {Map<string, Machine[]>} */
    const sites = new Map();
    for (const one of chosen) if (!apart(one.health)) sites.set(one.health.site, [...(sites.get(one.health.site) ?? []), one]);
    arrange(this.#sites, [...sites.keys()], this.#sections, (site) => html("site-section", { site }));
    for (const [site, machines] of sites) /** @type {import("./site-section.js").SiteSection} */ (this.#sections.get(site)).show(machines, chosen.filter(({ health }) => health.site === site).length - machines.length);
    const silent = chosen.filter(({ health }) => apart(health));
    arrange(this.#silent, silent.map(({ place }) => place), this.#tiles, (place) => html("machine-tile", { place }));
    this.#summary.textContent = `${silent.length} without data`;
    this.#apart.hidden = !silent.length;
    this.#none.hidden = chosen.length > 0;
    this.#none.textContent = all.length ? "No machine matches." : "Waiting for the machines …";
  }

  /** Number of machines in each state; states without machines are not offered. @param {Health[]} healths */
  #count(healths) {
    const chosen = this.#filter.value;
    const count = (/** @type {string} */ state) => healths.filter((one) => one.state === state || (state === "no-data" && one.stream.silent)).length;
    const options = [["", `all machines (${healths.length})`], ...Object.entries(STATES).flatMap(([state, text]) => (count(state) || state === chosen ? [[state, `${text} (${count(state)})`]] : []))];
    const said = options.map(([, text]) => text).join();
    if (this.#filter.dataset.said === said) return;
    this.#filter.dataset.said = said;
    this.#filter.replaceChildren(...options.map(([value, text]) => html("option", { value, selected: value === chosen }, text)));
  }
}

customElements.define("plant-view", PlantView);
