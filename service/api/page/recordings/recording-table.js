import { clock, lasting, size } from "../monitor/figures.js";
import { html, lay, renew, table } from "../elements/markup.js";
import { API } from "../monitor/monitor.js";

const PAGE = 25;

/** @import { AlarmEventData as AlarmEvent, RecordingEntry } from "../monitor/records.d.ts" */
/** @import { Chosen } from "./recordings-view.js" */

/** Recordings, the latest first, to choose from and to download. */
class RecordingTable extends HTMLElement {
  #shown = PAGE;
  /** @type {RecordingEntry[]} */
  #recordings = [];
  /** @type {Chosen} */
  #chosen = { ids: new Set(), stretch: null };

  /** @param {string} _place @param {RecordingEntry[]} recordings @param {AlarmEvent[]} _alarms @param {Chosen} chosen */
  show(_place, recordings, _alarms, chosen) {
    [this.#recordings, this.#chosen] = [recordings, chosen];
    this.#lay();
  }

  #lay() {
    const newest = [...this.#recordings].reverse();
    const rows = newest.slice(0, this.#shown).map((one, at) => {
      const [from, to] = [one.data_start_ns, one.data_end_ns];
      const able = one.complete && !one.problem && one.messages;
      const name = one.id.split("/").slice(2).join("/");
      const box = html("input", { type: "checkbox", value: one.id, checked: this.#chosen.ids.has(one.id), disabled: !able, change: (event) => this.#choose(one.id, event.target.checked) });
      return {
        key: one.id,
        cells: [
          html("label", { class: "check" }, box, html("span", {}, name)),
          html("time", { class: "number" }, clock(from)),
          html("span", { class: "number" }, from === null || to === null ? "–" : lasting((to - from) / 1e9)),
          html("time", { class: "number" }, clock(one.start_ns)),
          html("span", { class: "number" }, size(one.size_bytes)),
          html("span", {}, one.problem || (one.complete ? (one.messages ? "complete" : "empty") : "being written, or left by a crash")),
          html("span", { class: "wordy" }, one.kept_because ? (one.kept_because === newest[at - 1]?.kept_because ? "as above" : one.kept_because) : "no alarm"),
          one.complete ? html("div", {}, html("a", { href: `${API}/recordings/${one.id}/download`, download: name, "aria-label": `Download ${name}` }, "Download")) : "",
        ],
      };
    });
    const heads = ["recording", "data from", "length", "recorded from", "size", "state", "kept for", "file"];
    renew(this, rows.length ? table(heads, rows, "Recordings, the latest first") : null, newest.length > this.#shown ? html("button", { type: "button", click: () => this.#more() }, "Older") : null);
  }

  #more() {
    this.#shown += PAGE;
    this.#lay();
  }

  /** @param {string} id @param {boolean} wanted */
  #choose(id, wanted) {
    const ids = new Set(this.#chosen.ids);
    if (wanted) ids.add(id);
    else ids.delete(id);
    this.dispatchEvent(new CustomEvent("choose", { detail: { ids, stretch: null } }));
  }
}

customElements.define("recording-table", RecordingTable);
