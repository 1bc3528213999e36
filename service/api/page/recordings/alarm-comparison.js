import { clock, lasting } from "../monitor/figures.js";
import { html, lay, table } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor, pathOf } from "../monitor/monitor.js";
import { differences } from "./replay-list.js";
import "../elements/state-mark.js";

const EVENTS = 1000;
/** Largest time between two events of one alarm and kind that count as the same: windows of a replay may end at other times than the live ones. */
const SAME_NS = 120e9;

/** @import { AlarmEventData as AlarmEvent, ReplayJob } from "../monitor/records.d.ts" */

/**
 * Events of both lists in order of time; matching events are paired.
 * @param {AlarmEvent[]} here @param {AlarmEvent[]} there
 * @returns {{here?: AlarmEvent, there?: AlarmEvent}[]}
 */
function paired(here, there) {
  const left = new Set(there);
  const found = here.map((one) => {
    const [nearest] = [...left].filter((other) => other.name === one.name && other.kind === one.kind && Math.abs(other.time_ns - one.time_ns) <= SAME_NS).sort((a, b) => Math.abs(a.time_ns - one.time_ns) - Math.abs(b.time_ns - one.time_ns));
    left.delete(nearest);
    return { here: one, there: nearest };
  });
  const time = (/** @type {{here?: AlarmEvent, there?: AlarmEvent}} */ { here: one, there: other }) => Number((one ?? other)?.time_ns);
  return [...found, ...[...left].map((one) => ({ there: one }))].sort((one, other) => time(one) - time(other));
}

/** Text on where an event occurred. @param {AlarmEvent | undefined} here @param {AlarmEvent | undefined} there @param {string} other */
function where(here, there, other) {
  if (!here || !there) return html("strong", {}, here ? "this replay only" : `${other} only`);
  const later_s = (here.time_ns - there.time_ns) / 1e9;
  return Math.abs(later_s) < 0.5 ? "both" : `both, ${lasting(Math.abs(later_s))} ${later_s > 0 ? "later" : "earlier"} in this replay`;
}

/** Alarms that a replay would have raised, compared with those raised live or by another replay. */
class AlarmComparison extends LiveElement {
  #beside = /** @type {HTMLSelectElement} */ (html("select", { change: () => this.load() }));
  #rows = html("div");
  #place = "";
  /** @type {AlarmEvent[]} */
  #events = [];
  /** @type {[number, number]} */
  #span = [0, 0];
  /** @type {(ns: number) => void} */
  #go = () => {};

  /** @param {ReplayJob} job @param {AlarmEvent[]} events @param {[number, number]} span @param {(ns: number) => void} go */
  async show(job, events, span, go) {
    [this.#events, this.#span, this.#go] = [events, span, go];
    this.#place = job.recordings[0].split("/").slice(0, 2).join("/");
    lay(this, html("h2", {}, "What would have been raised"), html("label", {}, "Beside it: ", this.#beside), this.message, this.#rows);
    const all = /** @type {ReplayJob[]} */ ((await monitor.ask(`${API}/replays`)).replays);
    const same = all.filter((one) => one.id !== job.id && one.summary && one.recordings[0].startsWith(`${this.#place}/`));
    const live = await monitor.find(pathOf(this.#place));
    lay(
      this.#beside,
      live && html("option", { value: "live" }, "what the live monitor raised then"),
      ...same.map((one) => html("option", { value: one.id }, `replay of ${clock(one.started_ns)}, ${differences(one) || "as recorded"}`)),
      html("option", { value: "" }, "nothing"),
    );
    await this.load();
  }

  async ask() {
    const beside = this.#beside.value;
    const path = beside === "live" ? `${pathOf(this.#place)}/alarms/events?limit=${EVENTS}&since_ns=${this.#span[0]}&until_ns=${this.#span[1] + 1}` : `${API}/replays/${beside}/alarms?limit=${EVENTS}`;
    const found = beside ? (await monitor.ask(path)).events.map((/** @type {{data: AlarmEvent}} */ one) => one.data) : [];
    this.message.textContent = "";
    this.#lay(beside, found);
  }

  /** @param {string} beside @param {AlarmEvent[]} others */
  #lay(beside, others) {
    const own = ["raised", "escalated", "cleared"]; // a replay has no actions of operators
    const [ours, theirs] = [this.#events, others].map((list) => list.filter((one) => own.includes(one.kind)));
    const other = beside === "live" ? "live" : "the other replay";
    const rows = paired(ours, theirs).map(({ here, there }) => {
      const one = /** @type {AlarmEvent} */ (here ?? there);
      const cells = [
        html("time", { class: "number" }, clock(one.time_ns)),
        html("span", {}, one.kind),
        one.kind === "cleared" ? "" : html("state-mark", { state: one.severity }),
        html("span", {}, one.text),
        html("span", {}, beside ? where(here, there, other) : "this replay"),
        html("div", { class: "actions" }, html("button", { type: "button", "aria-label": `Show the window at ${clock(one.time_ns)}`, click: () => this.#go(one.time_ns) }, "Show window")),
      ];
      return { attributes: { class: one.kind === "cleared" ? null : one.severity }, cells };
    });
    lay(this.#rows, rows.length ? table(["time", "what", "severity", "event", "where", "window"], rows, "") : html("p", {}, beside ? `No alarm was raised, neither in this replay nor ${beside === "live" ? "live" : "in the other one"}.` : "No alarm would have been raised."));
  }
}

customElements.define("alarm-comparison", AlarmComparison);
