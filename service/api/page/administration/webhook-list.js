import { html, lay, table } from "../elements/markup.js";
import { clock } from "../monitor/figures.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";

/** @import { WebhookStatus } from "../monitor/records.d.ts" */

/** Webhooks, with the last event that each accepted, and its last error. */
class WebhookTable extends LiveElement {
  refreshS = 15;

  async ask() {
    const found = /** @type {WebhookStatus[]} */ ((await monitor.ask(`${API}/webhooks`)).webhooks);
    const rows = found.map((one) => ({
      cells: [
        html("div", {}, html("b", {}, one.name), html("div", { class: "note" }, one.target)),
        one.state === "working" ? html("span", {}, one.state) : html("strong", {}, one.state),
        html("span", {}, [one.machines.join(", "), one.kinds.join(", ") || "every kind", one.severities.join(", ") || "every severity", one.annunciated_only && "not shelved, suppressed or out of service"].filter(Boolean).join("; ")),
        html("span", { class: "number" }, one.delivered),
        html("span", { class: "number" }, one.pending),
        html("time", { class: "number" }, one.last_delivered_ns === null ? "never" : clock(one.last_delivered_ns)),
        html("span", {}, one.last_error ? `${clock(one.last_error_ns)}: ${one.last_error} (${one.failed_attempts} failed in all)` : "none"),
      ],
    }));
    const heads = ["webhook", "state", "receives", "delivered", "pending", "last delivery", "last error"];
    lay(this, rows.length ? table(heads, rows, "Webhooks, since the monitor started") : html("div", {}, html("h2", {}, "Webhooks"), html("p", { class: "note" }, "The settings name no webhook: no alarm events are posted over HTTP.")));
  }
}

customElements.define("webhook-list", WebhookTable);
