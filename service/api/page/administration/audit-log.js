import { html, lay, table } from "../elements/markup.js";
import { clock } from "../monitor/figures.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";

const PAGE = 50;

/** @import { AuditRecord } from "../monitor/records.d.ts" */

/** Outcome of a request, in words. @param {AuditRecord} one */
function outcome(one) {
  if (one.status === 0) return "outcome not known";
  const word = one.status < 300 ? "done" : [401, 403, 429].includes(one.status) ? "refused" : "failed";
  return `${word} (${one.status})`;
}

/** The audit log, newest first; the start of an action and its outcome are shown as one line. */
class AuditLog extends LiveElement {
  /** @type {AuditRecord[]} */
  #entries = [];
  /** @type {number | null} */
  #before = null;
  refreshS = 15;
  #rows = html("div");
  #older = html("button", { type: "button", hidden: true, click: () => this.attempt(() => this.#extend()) }, "Older");

  connectedCallback() {
    super.connectedCallback();
    this.#entries = [];
    this.replaceChildren(this.message, this.#rows, this.#older);
  }

  async ask() {
    const found = await monitor.ask(`${API}/audit?limit=${PAGE}`);
    const known = this.#entries[0]?.number ?? -1;
    const newer = found.entries.filter((/** @type {AuditRecord} */ one) => one.number > known);
    if (newer.length === PAGE || known < 0) [this.#entries, this.#before] = [newer, found.next_before]; // there may be further entries in between
    else this.#entries.unshift(...newer);
    if (newer.length || known < 0) this.#show();
    this.message.textContent = "";
  }

  async #extend() {
    const found = await monitor.ask(`${API}/audit?limit=${PAGE}&before=${this.#before}`);
    this.#entries.push(...found.entries);
    this.#before = found.next_before;
    this.#show();
  }

  #show() {
    const told = new Set();
    const shown = this.#entries.filter((one) => {
      const deed = `${one.at_ns} ${one.method} ${one.path}`;
      const announced = one.status === 0 && told.has(deed);
      told.add(deed);
      return !announced;
    });
    const rows = shown.map((one) => ({
      cells: [
        html("time", { class: "number" }, clock(one.at_ns)),
        html("span", {}, outcome(one)),
        html("span", {}, one.actor || "nobody"),
        html("span", { class: "number" }, one.address || "this computer"),
        html("span", {}, one.action && one.action !== "started" ? [one.action, one.machine, one.alarm].filter(Boolean).join(" ") : `${one.method} ${one.path}`),
        html("span", {}, one.reason),
      ],
    }));
    lay(this.#rows, rows.length ? table(["time", "outcome", "who", "from", "what", "reason"], rows, "Audit log, newest first") : html("div", {}, html("h2", {}, "Audit log"), html("p", { class: "note" }, "No changes have been requested yet.")));
    this.#older.hidden = this.#before === null;
  }
}

customElements.define("audit-log", AuditLog);
