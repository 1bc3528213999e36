import { html, lay } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { monitor } from "../monitor/monitor.js";
import "./audit-log.js";
import "./history-status.js";
import "./service-load.js";
import "./settings-list.js";
import "./token-list.js";
import "./webhook-list.js";

/** The service itself, for callers with the scope configure: load, tokens, webhooks, history, settings, audit log. */
class AdministrationView extends LiveElement {
  connectedCallback() {
    super.connectedCallback();
    this.follow("caller", () => this.#show());
    this.#show();
  }

  #show() {
    const title = html("h1", {}, "Administration");
    if (!monitor.caller) return lay(this, title);
    if (!monitor.may("configure")) return lay(this, title, html("p", {}, `This needs the scope configure; ${monitor.caller.name} has ${monitor.caller.scopes.join(", ") || "none"}.`));
    lay(this, title, html("service-load"), html("token-list"), html("webhook-list"), html("history-status"), html("settings-list"), html("audit-log"));
  }
}

customElements.define("administration-view", AdministrationView);
