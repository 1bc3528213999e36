import { clock, figure, lasting, percent, stretch } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";
import "../elements/state-mark.js";
import "../machine/level-table.js";
import "../machine/parameter-table.js";
import "./alarm-comparison.js";
import "./replay-trend.js";
import "./state-strip.js";
import "./window-plots.js";

const [WINDOWS, EVENTS, WAIT_MS] = [600, 1000, 120];
const RAISED = new Set(["raised", "escalated"]);

/** @import { AlarmEventData as AlarmEvent, Health, ReplayJob, Report } from "../monitor/records.d.ts" */

/** Results of an offline replay: state, parameters and levels over time, alarms, and the report of any window. */
class OfflineResult extends LiveElement {
  /** @type {ReplayJob | null} */
  #job = null;
  /** Every n-th window. @type {Report[]} */
  #reports = [];
  /** @type {AlarmEvent[]} */
  #events = [];
  #every = 1;
  #wanted = -1;
  message = html("p", { class: "message", role: "alert" });
  #facts = html("p", { class: "note" });
  #strip = /** @type {any} */ (html("state-strip"));
  #scrub = /** @type {HTMLInputElement} */ (html("input", { type: "range", min: 0, step: 1, value: 0, "aria-label": "Window", input: () => this.#go(Number(this.#scrub.value)) }));
  #place = html("output", { class: "number" });
  #window = html("div", { class: "window" });
  #tables = /** @type {any[]} */ ([html("parameter-table"), html("level-table")]);
  #trends = /** @type {any[]} */ ([html("replay-parameters"), html("replay-levels")]);
  #alarms = /** @type {any} */ (html("alarm-comparison"));
  #plots = /** @type {any} */ (null);

  get #path() {
    return `${API}/replays/${this.getAttribute("replay")}`;
  }

  /** The recorded machine, `site/machine`. */
  get #machine() {
    return this.#job?.recordings[0].split("/").slice(0, 2).join("/") ?? "";
  }

  /** @param {ReplayJob} job */
  async show(job) {
    if (this.#job || !job.summary) return;
    this.#job = job;
    const { windows } = job.summary;
    await this.attempt(() => this.#load(windows));
  }

  /** @param {number} windows */
  async #load(windows) {
    this.#every = Math.max(1, Math.ceil(windows / WINDOWS));
    const [reports, alarms] = await Promise.all([monitor.ask(`${this.#path}/reports?limit=1000&every=${this.#every}`), monitor.ask(`${this.#path}/alarms?limit=${EVENTS}`)]);
    this.#reports = reports.reports;
    this.#events = alarms.events.map((/** @type {{data: AlarmEvent}} */ one) => one.data);
    this.#said();
    if (!this.#reports.length) return lay(this, this.#facts, html("p", {}, "No window was evaluated: there were not enough data."));
    this.#scrub.max = String(windows - 1);
    const [first, last] = [this.#reports[0], this.#reports[this.#reports.length - 1]];
    const read = [...this.#reports].reverse().find((one) => one.parameters.some((each) => each.relative_change !== null)) ?? last;
    for (const trend of this.#trends) {
      trend.found = { reports: this.#reports, events: this.#events, limits: this.#job?.summary?.limits ?? {} };
      trend.feed(this.#health(read));
    }
    const jump = (/** @type {number} */ direction, /** @type {string} */ text) => html("button", { type: "button", click: () => this.#next(direction) }, text);
    this.#plots = html("window-plots", { place: this.#machine, replay: this.getAttribute("replay") });
    lay(
      this,
      this.#facts,
      this.#strip,
      this.#alarms,
      html("h2", {}, "Window by window"),
      html("div", { class: "scrubber" }, jump(-1, "◂ alarm event"), this.#scrub, jump(1, "alarm event ▸"), this.#place),
      this.message,
      this.#window,
      ...this.#tables,
      this.#plots,
      ...this.#trends,
      html("p", { class: "note" }, "From the API: ", html("a", { href: this.#path }, "replay"), ", ", html("a", { href: `${this.#path}/reports` }, "reports"), ", ", html("a", { href: `${this.#path}/alarms` }, "alarms")),
    );
    this.#strip.show(this.#reports, (/** @type {number} */ at) => this.#go(at * this.#every, true));
    this.#alarms.show(this.#job, this.#events, [first.start_ns, last.end_ns], (/** @type {number} */ ns) => this.#goTo(ns));
    await this.#go(windows - 1, true); // the final result
  }

  #said() {
    const { summary } = /** @type {ReplayJob} */ (this.#job);
    if (!summary) return;
    const refused = Object.entries(summary.refused_blocks).map(([why, count]) => `${why} ${count}`).join(", ");
    this.#facts.textContent = [
      `${lasting(summary.data_s)} of data in ${lasting(summary.elapsed_s)}, ${figure(summary.times_real_time)} times real time`,
      `${summary.blocks} blocks accepted, refused: ${refused || "none"}`,
      summary.gaps ? `gaps: ${summary.gaps}, ${figure(summary.missing_s)} s missing` : "no gaps",
      summary.first_windows,
      `evaluated as ${summary.site}/${summary.machine}, machine file ${summary.machine_hash}, bundle ${summary.bundle ?? "none"}`,
      ...summary.descriptor_differences,
      this.#every > 1 ? `plots show every ${this.#every}th window` : "",
      summary.stopped ? "stopped before the end" : "",
    ].filter(Boolean).join("; ");
  }

  /** A window in the form of a live health, with the alarms that would have been standing. @param {Report} report @returns {Health} */
  #health(report) {
    const [site, machine] = this.#machine.split("/");
    const latest = new Map(this.#events.filter((one) => one.time_ns <= report.end_ns && (RAISED.has(one.kind) || one.kind === "cleared")).map((one) => [one.name, one]));
    const alarms = [...latest.values()].map((one) => ({ ...one, raised: RAISED.has(one.kind) }));
    return /** @type {Health} */ (/** @type {unknown} */ ({ site, machine, state: report.state, reason: report.reason, filled: report.filled, report, alarms }));
  }

  /** Show a window. @param {number} at @param {boolean} [set] */
  async #go(at, set = false) {
    this.#wanted = at;
    if (set) this.#scrub.value = String(at);
    let report = at % this.#every === 0 ? this.#reports[at / this.#every] : undefined;
    if (!report) {
      await new Promise((resolve) => setTimeout(resolve, WAIT_MS)); // dragging the scrubber passes over many windows
      if (this.#wanted !== at) return;
      await this.attempt(async () => {
        [report] = (await monitor.ask(`${this.#path}/reports?offset=${at}&limit=1`)).reports;
        this.message.textContent = "";
      });
      if (this.#wanted !== at || !report) return;
    }
    this.#stand(report, at);
  }

  /** @param {Report} report @param {number} at */
  #stand(report, at) {
    const when = report.start_ns < report.end_ns ? stretch(report.start_ns, report.end_ns) : `until ${clock(report.end_ns)}`;
    const said = `window ${at + 1} of ${Number(this.#scrub.max) + 1}, ${when}`;
    this.#place.textContent = said;
    this.#scrub.setAttribute("aria-valuetext", `${said}, ${report.state}`);
    const health = this.#health(report);
    const standing = health.alarms.filter((one) => one.raised);
    lay(
      this.#window,
      html("div", { class: "states" }, html("state-mark", { state: report.state }), html("span", { class: "number" }, `${(100 * report.filled).toFixed(0)} % full${report.speed_rad_s === null ? "" : `, ${figure((report.speed_rad_s * 30) / Math.PI)} rpm`}`)),
      html("p", { class: "reason" }, report.reason),
      html("p", { class: "verdict" }, report.verdict && `${report.verdict.text}.${report.suspect ? ` Best explained by: ${report.suspect}.` : ""}`),
      html("ul", {}, ...[...report.sensors, ...report.shapes, ...(report.natural_frequencies ?? [])].map((one) => html("li", {}, one.text))),
      html("p", {}, standing.length ? "Raised in the replay by then: " : "No alarm raised in the replay by then.", standing.map((one) => `${one.name} (${one.severity}${one.relative_change === null ? "" : `, ${percent(one.relative_change)}`})`).join(", ")),
    );
    for (const one of this.#tables) one.feed(health);
    this.#plots.stand(report.end_ns, health);
    for (const one of [this.#strip, ...this.#trends]) one.mark(report.end_ns);
  }

  /** Go to the first window that ends at or after a time. @param {number} ns */
  #goTo(ns) {
    const found = this.#reports.findIndex((one) => one.end_ns >= ns);
    this.#go((found < 0 ? this.#reports.length - 1 : found) * this.#every, true);
    this.#scrub.focus();
  }

  /** Go to the previous or next alarm event. @param {number} direction */
  #next(direction) {
    const ends = this.#reports.map((one) => one.end_ns);
    const moments = [...new Set(this.#events.map((one) => ends.findIndex((end) => end >= one.time_ns)).filter((at) => at >= 0).map((at) => at * this.#every))].sort((one, other) => one - other);
    const here = Number(this.#scrub.value);
    const found = direction > 0 ? moments.find((at) => at > here) : moments.reverse().find((at) => at < here);
    if (found === undefined) this.message.textContent = direction > 0 ? "No alarm event after this window." : "No alarm event before this window.";
    else {
      this.message.textContent = "";
      this.#go(found, true);
    }
  }
}

customElements.define("offline-result", OfflineResult);
