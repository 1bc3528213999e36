import { html, lay, table } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";

/** @import { SettingList } from "../monitor/records.d.ts" */

/** The settings of the monitor as they are in use. */
class SettingTable extends LiveElement {
  heading = "Settings";

  connectedCallback() {
    super.connectedCallback();
    this.load();
  }

  async ask() {
    const { settings } = /** @type {SettingList} */ (await monitor.ask(`${API}/settings`));
    const rows = Object.entries(settings).flatMap(([part, fields]) => Object.entries(fields).map(([name, value]) => ({ cells: [`[${part}] ${name}`, html("span", {}, value === null ? "left out" : `${value}`)] })));
    lay(this, html("h2", {}, this.heading), table(["setting", "value"], rows, "Settings in use, except machines, access, webhooks, history, fleet and Zenoh"));
  }
}

customElements.define("settings-list", SettingTable);
