import { html, lay } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor, pathOf } from "../monitor/monitor.js";
import "./recording-line.js";
import "./recording-table.js";
import "./replay-list.js";
import "./replay-order.js";

const [LATEST, EVENTS] = [200, 200];

/** @import { AlarmEventData as AlarmEvent, RecordingEntry } from "../monitor/records.d.ts" */
/** Selection for a replay: ids of recordings, and a stretch of time if not everything. @typedef {{ids: Set<string>, stretch: [number, number] | null}} Chosen */

/** Recordings of one machine with its alarms, and replays of them. */
class RecordingsView extends LiveElement {
  #machine = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Machine", change: () => this.#other() }));
  refreshS = 30;
  #line = /** @type {any} */ (html("recording-line"));
  #table = /** @type {any} */ (html("recording-table"));
  #order = /** @type {any} */ (html("replay-order"));
  #parts = [this.#line, this.#order, this.#table];
  #said = "";
  /** @type {RecordingEntry[]} */
  #recordings = [];
  /** @type {AlarmEvent[]} */
  #alarms = [];
  /** @type {Chosen} */
  #chosen = { ids: new Set(), stretch: null };

  connectedCallback() {
    super.connectedCallback();
    for (const part of this.#parts)
      part.addEventListener("choose", (/** @type {CustomEvent<Chosen>} */ { detail }) => {
        this.#chosen = detail;
        this.#show();
      });
    lay(this, html("div", { class: "tools" }, html("h1", {}, "Recordings"), this.#machine), this.message, ...this.#parts, html("replay-list"));
    let heard = monitor.machines.size;
    this.follow("health", () => {
      if (!this.#said || heard === monitor.machines.size) return; // no statement before recordings have been requested
      heard = monitor.machines.size;
      this.#show();
    });
  }

  #other() {
    this.#chosen = { ids: new Set(), stretch: null };
    this.#said = "";
    this.load();
  }

  async ask() {
    const newest = /** @type {RecordingEntry[]} */ ((await monitor.ask(`${API}/recordings?latest=1`)).recordings);
    this.#offer(newest.length > 0);
    const places = [...new Set(newest.map((one) => `${one.site}/${one.machine}`))];
    const chosen = this.#machine.value || decodeURIComponent(this.getAttribute("place") ?? "") || places[0];
    if (this.#machine.options.length !== places.length) this.#machine.replaceChildren(...places.map((place) => html("option", { value: place, selected: place === chosen }, place)));
    if (!places.length) {
      this.message.textContent = "Nothing has been recorded yet.";
      return;
    }
    const place = this.#machine.value;
    const [site, machine] = place.split("/");
    const asked = new URLSearchParams({ site, machine, latest: String(LATEST), data_times: "true" });
    const recordings = /** @type {RecordingEntry[]} */ ((await monitor.ask(`${API}/recordings?${asked}`)).recordings);
    const from = Math.min(...recordings.map((one) => one.data_start_ns ?? Infinity));
    // A recorded machine may not be monitored any more.
    const alarms = Number.isFinite(from) ? ((await monitor.find(`${pathOf(place)}/alarms/events?kind=raised&limit=${EVENTS}&since_ns=${from}`))?.events ?? []) : [];
    if (place !== this.#machine.value) return;
    this.#recordings = recordings;
    this.#alarms = alarms.map((/** @type {{data: AlarmEvent}} */ one) => one.data);
    this.message.textContent = recordings.length === LATEST ? `The latest ${LATEST} recordings are shown.` : "";
    const said = JSON.stringify([recordings, this.#alarms]);
    if (said === this.#said) return;
    this.#said = said;
    this.#show();
  }

  /** Hide the selection if there are no recordings. @param {boolean} any */
  #offer(any) {
    for (const part of [this.#machine, ...this.#parts]) part.hidden = !any;
  }

  #show() {
    for (const part of this.#parts) part.show(this.#machine.value, this.#recordings, this.#alarms, this.#chosen);
  }

  /** @param {string} why */
  refused(why) {
    this.#offer(this.#recordings.length > 0);
    super.refused(why);
  }
}

customElements.define("recordings-view", RecordingsView);
