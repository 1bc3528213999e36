import { html, lay, table } from "../elements/markup.js";
import { clock, size } from "../monitor/figures.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";

/** @import { HistoryStatus } from "../monitor/records.d.ts" */

/** Size, time span and retention of the history. */
class HistoryStatusTable extends LiveElement {
  refreshS = 60;
  heading = "History";

  async ask() {
    const found = /** @type {HistoryStatus} */ (await monitor.ask(`${API}/history`));
    const time = (/** @type {number | null} */ ns) => html("time", { class: "number" }, ns === null ? "none" : clock(ns));
    const rows = found.machines.map((one) => ({ cells: [`${one.site}/${one.machine}`, time(one.oldest_event_ns), time(one.oldest_report_ns), time(one.oldest_reading_ns)] }));
    const fact = (/** @type {string} */ name, /** @type {string} */ text) => [html("dt", {}, name), html("dd", {}, text)];
    lay(
      this,
      html("h2", {}, this.heading),
      html("dl", {}, ...fact("database", found.database), ...fact("size", size(found.size_bytes)), ...fact("alarm events", "kept for ever"), ...fact("full reports", `kept for ${found.reports_days} days`), ...fact("readings of each window", `kept for ${found.readings_days} days`), ...fact("reduced readings", `kept for ${found.buckets_days} days`)),
      rows.length ? table(["machine", "alarm event", "report", "reading"], rows, "Oldest data, by machine") : html("p", { class: "note" }, "Nothing is stored for any machine yet."),
    );
  }
}

customElements.define("history-status", HistoryStatusTable);
