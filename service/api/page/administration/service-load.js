import { html, renew, table } from "../elements/markup.js";
import { lasting } from "../monitor/figures.js";
import { LiveElement } from "../elements/live-element.js";
import { monitor, Refused } from "../monitor/monitor.js";
import "../elements/state-mark.js";

/** @import { Readiness } from "../monitor/records.d.ts" */

/** Readiness of the service, and the load of each machine's monitor. */
class ServiceLoad extends LiveElement {
  refreshS = 10;
  heading = "Service";
  /** Machines whose health had not arrived when they were shown. @type {Set<string>} */
  #unheard = new Set();

  connectedCallback() {
    super.connectedCallback();
    this.follow("health", ({ detail }) => this.#unheard.has(detail) && this.load());
  }

  async ask() {
    try {
      this.#show(await monitor.ask("/readyz"));
    } catch (error) {
      if (!(error instanceof Refused) || !error.body.machines) throw error;
      this.#show(error.body); // not ready; the body states the reasons
    }
  }

  /** @param {Readiness} found */
  #show(found) {
    this.#unheard = new Set(found.machines.map((one) => `${one.site}/${one.machine}`).filter((place) => !monitor.machines.has(place)));
    const rows = found.machines.map((one) => {
      const place = `${one.site}/${one.machine}`;
      const quality = monitor.machines.get(place)?.health.quality;
      const age = monitor.dataAge(place);
      const number = (/** @type {string | number | undefined} */ value) => html("span", { class: "number" }, value ?? "–");
      const trouble = [!one.worker_alive && "its thread has stopped", one.trouble, one.worker_errors > 0 && `${one.worker_errors} errors inside the monitor, the latest: ${one.last_worker_error}`].filter(Boolean);
      return {
        key: place,
        cells: [
          html("a", { href: `#/machines/${place}` }, place),
          html("state-mark", { state: one.state }),
          number(age !== null ? lasting(age) : monitor.machines.has(place) ? "none since the monitor started" : "–"),
          number(one.queue_blocks),
          number(one.worker_busy_s < 1 ? "idle" : `${one.worker_busy_s.toFixed(0)} s on one block`),
          number(quality?.queue_dropped_blocks),
          number(quality?.link_missed_blocks),
          number(one.history_waiting),
          html("span", {}, one.recording),
          html("span", {}, trouble.join("; ") || "none"),
        ],
      };
    });
    const heads = ["machine", "state", "age of data", "blocks waiting", "at work", "dropped (overload)", "lost in transit", "steps not in history", "recording", "trouble"];
    renew(
      this,
      html("h2", {}, this.heading),
      html("p", {}, found.ready ? "Ready: everything that monitoring needs is working." : html("strong", {}, "Not ready.")),
      html("ul", {}, ...[...found.reasons, ...found.failing_webhooks.map((one) => `webhook ${one}`)].map((one) => html("li", {}, one))),
      rows.length ? table(heads, rows, "Lag and load by machine") : null,
      html("p", { class: "note" }, "Block counts are since the monitor started; waiting blocks are evaluated in order of arrival."),
    );
  }
}

customElements.define("service-load", ServiceLoad);
