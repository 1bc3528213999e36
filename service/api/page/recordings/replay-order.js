import { stretch } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { API, monitor } from "../monitor/monitor.js";
import { counted } from "./replay-list.js";

const LARGEST = 100_000;

/** @import { AlarmEventData as AlarmEvent, RecordingEntry } from "../monitor/records.d.ts" */
/** @import { Chosen } from "./recordings-view.js" */

/** A form that starts a replay of the selection: unchanged, or with another machine file (also a local one) or another limit. */
class ReplayOrder extends HTMLElement {
  #what = html("p", { role: "status" });
  #message = html("p", { class: "message", role: "alert" });
  #machine = /** @type {HTMLSelectElement} */ (html("select"));
  #file = /** @type {HTMLInputElement} */ (html("input", { type: "file", accept: ".toml", change: () => this.#offer() }));
  #raise = /** @type {HTMLInputElement} */ (html("input", { type: "number", min: 0.1, max: 99, step: "any", placeholder: "as in the file" }));
  #delay = /** @type {HTMLInputElement} */ (html("input", { type: "number", min: 0, max: 86400, step: "any", placeholder: "as in the file" }));
  #lines = /** @type {HTMLTextAreaElement} */ (html("textarea", { rows: 2, spellcheck: "false", placeholder: "alarms.parameters.k_by.raise_above = 0.2" }));
  #mode = /** @type {HTMLSelectElement} */ (html("select", { change: () => this.#offer() }, html("option", { value: "offline" }, "as fast as possible, resulting in reports and alarms"), html("option", { value: "paced" }, "onto the network at a pace, for a monitor in its own namespace")));
  #pace = /** @type {HTMLInputElement} */ (html("input", { type: "number", min: 0.1, max: 1000, step: "any", value: 10, required: true }));
  #offline = html("div", { class: "offline" });
  #paced = html("label", { hidden: true }, "Seconds of data per second", this.#pace);
  #start = /** @type {HTMLButtonElement} */ (html("button", { type: "submit", class: "main" }, "Start replay"));
  #clear = html("button", { type: "button", click: () => this.dispatchEvent(new CustomEvent("choose", { detail: { ids: new Set(), stretch: null } })) }, "Clear selection");
  /** @type {Chosen} */
  #chosen = { ids: new Set(), stretch: null };

  connectedCallback() {
    lay(
      this.#offline,
      html("label", {}, "Machine file", this.#machine),
      html("label", {}, "Or a file from this computer (TOML)", this.#file),
      html("label", {}, "Alert when a parameter has changed by more than, %", this.#raise),
      html("label", {}, "On-delay, s", this.#delay),
      html("label", { class: "lines" }, "Lines that override the machine file, one per line", this.#lines),
    );
    lay(this, html("form", { submit: (event) => this.#submit(event) }, html("h2", {}, "Replay"), this.#what, html("label", {}, "How", this.#mode), this.#offline, this.#paced, html("div", { class: "actions" }, this.#start, this.#clear), this.#message));
    this.show("", [], [], this.#chosen);
  }

  #offer() {
    this.#offline.hidden = this.#mode.value !== "offline";
    this.#paced.hidden = !this.#offline.hidden;
    this.#machine.disabled = Boolean(this.#file.files?.length);
  }

  /** @param {string} place @param {RecordingEntry[]} _recordings @param {AlarmEvent[]} _alarms @param {Chosen} chosen */
  show(place, _recordings, _alarms, chosen) {
    this.#chosen = chosen;
    const others = [...monitor.machines.keys()].filter((one) => one !== place).sort();
    if (this.#machine.options.length !== others.length + 1 || this.#machine.dataset.place !== place) {
      this.#machine.dataset.place = place;
      this.#machine.replaceChildren(html("option", { value: "" }, "of this machine"), ...others.map((one) => html("option", { value: one }, `of ${one}`)));
    }
    const count = chosen.ids.size;
    const may = monitor.may("operate");
    this.#what.textContent = !may
      ? "You have read access only: starting a replay needs the scope operate."
      : count
        ? `${counted(count, "recording")} of ${place}${chosen.stretch ? `, of them ${stretch(...chosen.stretch)}` : ""}.`
        : "Choose recordings below, or those around an alarm above.";
    this.#start.disabled = !count || !may;
    this.#clear.hidden = !count;
  }

  #changes() {
    const raise = this.#raise.value ? Number(this.#raise.value) / 100 : null;
    // The limit for clearing is scaled in proportion: 6 % for 10 %.
    const limits = raise === null ? [] : [`alarms.limits.raise_above = ${raise}`, `alarms.limits.clear_below = ${Number((0.6 * raise).toPrecision(6))}`];
    const delay = this.#delay.value ? [`alarms.on_delay_s = ${Number(this.#delay.value)}`] : [];
    return [...limits, ...delay, ...this.#lines.value.split("\n").map((one) => one.trim()).filter(Boolean)];
  }

  /** Arguments for another machine file than the machine's own. @returns {Promise<Record<string, string>>} */
  async #machineFile() {
    const [file] = this.#file.files ?? [];
    if (!file) return this.#machine.value ? { machine: this.#machine.value } : {};
    if (file.size > LARGEST) throw new Error(`${file.name} is too large for a machine file.`);
    const name = file.name.replace(/\.toml$/i, "").replace(/[^A-Za-z0-9_. -]/g, "_").slice(0, 90);
    return { machine_file: await file.text(), machine_file_name: `${/^[A-Za-z0-9]/.test(name) ? "" : "file"}${name}.toml` };
  }

  /** @param {Event} event */
  async #submit(event) {
    event.preventDefault();
    const mode = this.#mode.value;
    const times = this.#chosen.stretch ? { from_ns: this.#chosen.stretch[0], to_ns: this.#chosen.stretch[1] } : {};
    this.#start.disabled = true;
    try {
      const how = mode === "paced" ? { pace: Number(this.#pace.value) } : { ...(await this.#machineFile()), changes: this.#changes() };
      const job = await monitor.order(`${API}/replays`, { recordings: [...this.#chosen.ids], mode, ...times, ...how });
      location.hash = `#/replays/${job.id}`;
    } catch (error) {
      this.#message.textContent = `Not started. ${error instanceof Error ? error.message : String(error)}`;
      this.#start.disabled = false;
    }
  }
}

customElements.define("replay-order", ReplayOrder);
