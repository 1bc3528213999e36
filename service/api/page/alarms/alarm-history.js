import { clock } from "../monitor/figures.js";
import { html, renew, table } from "../elements/markup.js";
import { monitor, pathOf } from "../monitor/monitor.js";
import { MachineElement } from "../elements/machine-element.js";
import { timeLine } from "./alarm-time-line.js";
import { why } from "./why-link.js";
import "../elements/state-mark.js";

const PAGE = 50;

/** @import { AlarmEventData as AlarmEvent } from "../monitor/records.d.ts" */

/** Alarm events of a machine, newest first. */
class AlarmHistory extends MachineElement {
  /** @type {AlarmEvent[]} */
  #events = [];
  /** @type {number | null} */
  #before = null;
  needsWhole = false;

  connectedCallback() {
    super.connectedCallback();
    this.follow("alarm", ({ detail }) => {
      if (`${detail.site}/${detail.machine}` !== this.place || this.#events[0]?.sequence >= detail.sequence) return;
      this.#events.unshift(detail);
      this.#lay();
    });
    this.#events = [];
    this.#before = null;
    this.#load();
  }

  async #load() {
    const older = this.#before === null ? "" : `&before=${this.#before}`;
    await this.attempt(async () => {
      const found = await monitor.ask(`${pathOf(this.place)}/alarms/events?limit=${PAGE}${older}`);
      this.#events.push(...found.events.map((/** @type {{data: AlarmEvent}} */ one) => one.data));
      this.#before = found.next_before;
      this.message.textContent = "";
    });
    this.#lay();
  }

  #lay() {
    const rows = this.#events.map((one) => ({
      key: one.sequence,
      cells: [
        html("time", { class: "number" }, clock(one.time_ns)),
        html("span", {}, one.kind),
        html("span", {}, one.text, " ", one.kind === "raised" && why(this.place, one)),
        html("span", {}, one.actor || "monitor"),
        html("span", {}, one.reason),
      ],
    }));
    renew(
      this,
      this.message,
      html("h2", {}, `History of ${this.place}`),
      timeLine(this.#events, this.health?.report?.end_ns ?? 0),
      rows.length ? table(["time", "what", "event", "by", "reason"], rows, "") : html("p", { class: "note" }, "This machine has no alarm events yet."),
      this.#before === null ? "" : html("button", { type: "button", click: () => this.#load() }, "Older"),
    );
  }
}

customElements.define("alarm-history", AlarmHistory);
