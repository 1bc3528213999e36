import { html } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { monitor } from "../monitor/monitor.js";
import { standing } from "./alarm-strip.js";
import "./alarm-history.js";
import "./alarm-list.js";

/** Alarms of the whole plant: those that are not normal, and the history of one machine. */
class AlarmsView extends LiveElement {
  #choice = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Machine", change: () => this.#choose() }));
  #chosen = "";
  #history = html("div");
  #rights = html("p", { class: "note" });

  connectedCallback() {
    super.connectedCallback();
    this.replaceChildren(html("h1", {}, "Alarms"), this.#rights, html("alarm-list"), html("div", { class: "tools" }, html("h2", {}, "History"), this.#choice), this.#history);
    this.follow("health", () => this.#offer());
    this.follow("connection", () => this.#offer());
    this.#offer();
  }

  /** Offer all known machines; initially, the one with the most urgent alarm is selected. */
  #offer() {
    this.#rights.textContent = !monitor.connected || monitor.may("operate") ? "" : "You have read access only: acknowledging and shelving need the scope operate.";
    const places = [...monitor.machines.keys()].sort();
    if ([...this.#choice.options].map((one) => one.value).join() === places.join()) return;
    const chosen = this.#chosen || standing()[0]?.place; // machines become known one after the other
    this.#choice.replaceChildren(...places.map((place) => html("option", { value: place, selected: place === chosen }, place)));
    if (this.#history.firstElementChild?.getAttribute("place") !== this.#choice.value) this.#show();
  }

  #choose() {
    this.#chosen = this.#choice.value;
    this.#show();
  }

  #show() {
    this.#history.replaceChildren(html("alarm-history", { place: this.#choice.value }));
  }
}

customElements.define("alarms-view", AlarmsView);
