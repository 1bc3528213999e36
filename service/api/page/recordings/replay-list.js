import { clock } from "../monitor/figures.js";
import { html, renew, table } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";

/** @import { ReplayJob } from "../monitor/records.d.ts" */

/** Differences of a replay from live operation. @param {ReplayJob} job */
export const differences = (job) => [job.machine && `${job.machine_file_sent ? "another machine file, " : "machine file "}${job.machine.split("/").pop()}`, ...(job.changes ?? [])].filter(Boolean).join("; ");

/** @param {number} count @param {string} word */
export const counted = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;

/** Result of a replay so far. @param {ReplayJob} job */
export function outcome(job) {
  if (job.error) return job.error;
  if (job.summary) return `${counted(job.summary.windows, "window")}, ${counted(job.summary.alarms, "alarm event")}; raised at the end: ${job.summary.raised.join(", ") || "none"}`;
  return job.progress ? `${(100 * job.progress.fraction).toFixed(0)} % done` : "begins";
}

/** Replays since the service started, the latest first. */
class ReplayList extends LiveElement {
  refreshS = 10;
  #said = "";

  connectedCallback() {
    super.connectedCallback();
    this.#said = "";
  }

  async ask() {
    const found = /** @type {ReplayJob[]} */ ((await monitor.ask(`${API}/replays`)).replays);
    const said = JSON.stringify(found);
    if (said === this.#said && this.answered) return; // unanswered, a message stands in place of the list
    this.#said = said;
    const rows = found.map((one) => ({
      key: one.id,
      cells: [
        html("a", { href: `#/replays/${one.id}` }, clock(one.started_ns)),
        html("span", {}, one.state),
        html("span", {}, one.mode === "paced" ? `paced, ${one.pace} s of data per second` : "as fast as possible"),
        html("span", {}, [...new Set(one.recordings.map((id) => id.split("/").slice(0, 2).join("/")))].join(", "), ` (${one.recordings.length})`),
        html("span", {}, differences(one) || "as recorded"),
        html("span", {}, outcome(one)),
      ],
    }));
    renew(this, rows.length ? table(["started", "state", "how", "recordings", "with", "outcome"], rows, "Replays since the service started") : html("p", { class: "note" }, "Nothing has been replayed since the service started."));
  }
}

customElements.define("replay-list", ReplayList);
