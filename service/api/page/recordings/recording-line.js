import { clock, stretch } from "../monitor/figures.js";
import { html, lay, renew, svg, table } from "../elements/markup.js";
import { within } from "./stretches.js";
import "../elements/state-mark.js";

const [WIDTH, HEIGHT, LEAST, SHOWN, AROUND_S] = [1000, 26, 2, 10, 600];
const RANGES = /** @type {[string, string][]} */ ([["", "everything shown below"], ["720", "last 30 days"], ["24", "last 24 h"], ["1", "last hour"]]);

/** @import { AlarmEventData as AlarmEvent, RecordingEntry } from "../monitor/records.d.ts" */
/** @import { Chosen } from "./recordings-view.js" */

/** Recordings on a time line, with the machine's alarms above; clicking an alarm selects the recordings around it. */
class RecordingLine extends HTMLElement {
  #range = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Range of the timeline", change: () => this.#draw() }, ...RANGES.map(([hours, text]) => html("option", { value: hours }, text))));
  #picture = html("div", { class: "time-line" });
  #alarms = html("div");
  /** @type {{place: string, recordings: RecordingEntry[], alarms: AlarmEvent[], chosen: Chosen} | null} */
  #known = null;

  connectedCallback() {
    lay(this, html("label", {}, "Timeline: ", this.#range), this.#picture, this.#alarms);
  }

  /** @param {string} place @param {RecordingEntry[]} recordings @param {AlarmEvent[]} alarms @param {Chosen} chosen */
  show(place, recordings, alarms, chosen) {
    this.#known = { place, recordings: recordings.filter((one) => one.data_start_ns !== null && one.data_end_ns !== null), alarms, chosen };
    this.#draw();
  }

  #draw() {
    if (!this.#known) return;
    const { recordings, alarms, chosen } = this.#known;
    if (!recordings.length) {
      lay(this.#picture, html("p", { class: "note" }, "No recording of this machine has been completed yet."));
      return lay(this.#alarms);
    }
    const last = Math.max(...recordings.map((one) => Number(one.data_end_ns)));
    const hours = Number(this.#range.value);
    const first = hours ? last - hours * 3600e9 : Math.min(...recordings.map((one) => Number(one.data_start_ns)));
    const x = (/** @type {number} */ ns) => (WIDTH * (ns - first)) / (last - first || 1);
    const seen = alarms.filter((one) => one.time_ns >= first && one.time_ns <= last);
    const bars = recordings
      .filter((one) => Number(one.data_end_ns) >= first)
      .map((one) => {
        const [from, to] = [Math.max(0, x(Number(one.data_start_ns))), x(Number(one.data_end_ns))];
        const kind = [one.kept_because && "kept", chosen.ids.has(one.id) && "chosen"].filter(Boolean).join(" ");
        return svg("rect", { class: kind || null, x: Math.min(from, WIDTH - LEAST), y: chosen.ids.has(one.id) ? 2 : one.kept_because ? 5 : 8, width: Math.max(LEAST, to - from - 1), height: chosen.ids.has(one.id) ? 22 : one.kept_because ? 16 : 10 }, svg("title", {}, `${one.id}${one.kept_because ? `, kept because of ${one.kept_because}` : ""}`));
      });
    const marks = seen.map((one) => {
      const mark = svg("svg", { viewBox: "-8 0 16 18", class: one.severity }, svg("title", {}, `${clock(one.time_ns)}: ${one.text}`), svg("path", { d: one.severity === "danger" ? "M0 1 8 9 0 17-8 9Z" : "M0 1 8 17-8 17Z" }));
      mark.style.left = `${(100 * x(one.time_ns)) / WIDTH}%`;
      return mark;
    });
    const times = chosen.stretch ? chosen.stretch.map((one) => Math.min(WIDTH, Math.max(0, x(one)))) : null;
    lay(
      this.#picture,
      html("div", { class: "alarm-marks", "aria-hidden": "true" }, ...marks),
      svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", role: "img", "aria-label": `${bars.length} recordings, ${seen.length} alarms raised, ${stretch(first, last)}` }, times && svg("rect", { class: "stretch", x: times[0], y: 0, width: Math.max(LEAST, times[1] - times[0]), height: HEIGHT }), ...bars),
      html("p", { class: "ends note" }, html("span", {}, clock(first)), html("span", {}, clock(last))),
      html("p", { class: "keys" }, html("span", { class: "key bar" }, "recording"), html("span", { class: "key bar kept" }, "kept for an alarm"), html("span", { class: "key bar chosen" }, "chosen"), html("span", {}, "▲ alert raised"), html("span", {}, "◆ danger raised"), html("span", {}, "times of the data")),
    );
    this.#list(seen);
  }

  /** The latest alarms, as buttons that select the recordings around them. @param {AlarmEvent[]} seen */
  #list(seen) {
    const rows = seen.slice(0, SHOWN).map((one) => ({
      key: one.sequence,
      cells: [
        html("time", { class: "number" }, clock(one.time_ns)),
        html("state-mark", { state: one.severity }),
        html("span", {}, one.text),
        html("div", { class: "actions" }, this.#around(one).size ? html("button", { type: "button", "aria-label": `Choose ten minutes before and after ${one.text}`, click: () => this.#choose(one) }, "Choose ± 10 min") : html("span", { class: "note" }, "not recorded")),
      ],
    }));
    renew(this.#alarms, rows.length ? table(["raised", "severity", "alarm", "recording"], rows, seen.length > SHOWN ? `Alarms, the latest ${SHOWN} of ${seen.length}` : "Alarms") : html("p", { class: "note" }, "No alarm was raised in this time, according to this monitor's history."));
  }

  /** @param {AlarmEvent} one @returns {Set<string>} */
  #around(one) {
    return within(this.#known?.recordings ?? [], one.time_ns - AROUND_S * 1e9, one.time_ns + AROUND_S * 1e9);
  }

  /** @param {AlarmEvent} one */
  #choose(one) {
    const ids = this.#around(one);
    const there = (this.#known?.recordings ?? []).filter((each) => ids.has(each.id));
    const from = Math.max(one.time_ns - AROUND_S * 1e9, Math.min(...there.map((each) => Number(each.data_start_ns))));
    const to = Math.min(one.time_ns + AROUND_S * 1e9, Math.max(...there.map((each) => Number(each.data_end_ns))));
    const detail = { ids, stretch: [from, to] };
    this.dispatchEvent(new CustomEvent("choose", { detail }));
  }
}

customElements.define("recording-line", RecordingLine);
