import { clock, interval, percent } from "../monitor/figures.js";
import { html, table } from "../elements/markup.js";
import { monitor, Refused } from "../monitor/monitor.js";
import { byUrgency, UNSEEN } from "../monitor/states.js";
import { ordered } from "./alarm-order.js";
import "../elements/state-mark.js";

/** @typedef {import("../monitor/records.js").Alarm} Alarm */
/** @typedef {{place: string, alarm: Alarm}} Placed */

/** Why it is silenced, or how large the change is, or what the note says. @param {Alarm} alarm */
function known(alarm) {
  const { shelf, interval_95: range, relative_change: change } = alarm;
  if (shelf) return `shelved by ${shelf.by} until ${clock(shelf.until_ns)}${shelf.one_shot ? " or until it clears" : ""}: ${shelf.reason}`;
  if (alarm.out_of_service_by) return `taken out of service by ${alarm.out_of_service_by}: ${alarm.out_of_service_reason}`;
  if (alarm.suppressed_by) return `suppressed: ${alarm.suppressed_by}`;
  const size = change !== null && range ? `${percent(change)} (${interval(range)})${alarm.low_confidence ? ", low confidence: outside the model" : ""}` : "";
  return [size, alarm.note].filter(Boolean).join("; ");
}

/** Where it is said what an alarm rests on. @param {string} place @param {{name: string, occurrence: number}} alarm */
export const whyOf = (place, { name, occurrence }) => `#/why/${place}/${encodeURIComponent(name)}/${occurrence}`;

/** What can be done to an alarm as it is: the order, the button, and the scope that takes. @param {Alarm} alarm @returns {[string, string, string, boolean][]} */
function operations(alarm) {
  const silenced = ["shelved", "out-of-service"].includes(alarm.state);
  /** @type {[string, string, string, boolean][]} */
  const all = [
    ["acknowledge", "Acknowledge", "operate", UNSEEN.has(alarm.state)],
    ["reset", "Reset", "operate", alarm.state.startsWith("latched")],
    ["shelve", "Shelve …", "operate", !silenced && alarm.state !== "normal"],
    ["unshelve", "Unshelve", "operate", alarm.state === "shelved"],
    ["remove-from-service", "Out of service …", "configure", alarm.state !== "out-of-service"],
    ["return-to-service", "Return to service", "configure", alarm.state === "out-of-service"],
  ];
  return all.filter(([, , scope, possible]) => possible && monitor.may(scope));
}

/** Alarms that are not normal, with what can be done to them: of all machines, of one `place="site/machine"`, or one `alarm="k_by"` of that. */
class AlarmList extends HTMLElement {
  #gone = new AbortController();
  #said = "";
  #message = html("p", { role: "status", class: "message" });
  #rows = html("div");

  connectedCallback() {
    this.#gone = new AbortController();
    const place = this.getAttribute("place");
    const heard = { signal: this.#gone.signal };
    monitor.addEventListener(place ? `health:${place}` : "health", () => this.#show(), heard);
    monitor.addEventListener("connection", () => this.#show(), heard);
    this.replaceChildren(this.#message, this.#rows);
    this.#said = "";
    this.#show();
  }

  disconnectedCallback() {
    this.#gone.abort();
  }

  /** @returns {Placed[]} */
  #alarms() {
    const [only, name] = [this.getAttribute("place"), this.getAttribute("alarm")];
    return [...monitor.machines]
      .filter(([place]) => !only || place === only)
      .flatMap(([place, { health }]) => health.alarms.filter((alarm) => !name || alarm.name === name).map((alarm) => ({ place, alarm })))
      .sort((one, other) => byUrgency(one.alarm, other.alarm));
  }

  /** Only if something has changed: whoever is about to press a button shall not miss it. */
  #show() {
    const all = this.#alarms();
    const said = JSON.stringify([all.map(({ place, alarm }) => [place, { ...alarm, evidence: null }]), monitor.caller?.scopes]);
    if (said === this.#said) return;
    this.#said = said;
    const focused = document.activeElement instanceof HTMLElement ? document.activeElement.dataset.order : undefined;
    const rows = all.map((one) => this.#row(one));
    const heads = ["alarm", "state", "since", "what is known", "actions"];
    this.#rows.replaceChildren(rows.length ? table(heads, rows, this.hasAttribute("alarm") ? "Now" : "Alarms that are not normal") : html("p", { class: "note" }, this.hasAttribute("alarm") ? "The alarm is normal now." : "No alarm is raised, and none waits to be acknowledged."));
    if (focused) /** @type {HTMLElement | null} */ (this.#rows.querySelector(`[data-order="${CSS.escape(focused)}"]`))?.focus();
  }

  /** @param {Placed} one */
  #row({ place, alarm }) {
    const machine = this.hasAttribute("place") ? null : html("a", { href: `#/machines/${place}` }, place);
    const buttons = operations(alarm).map(([kind, text]) =>
      html("button", { type: "button", "data-order": `${place} ${alarm.name} ${kind}`, click: () => this.#operate(place, alarm, kind) }, text),
    );
    return {
      attributes: { class: [alarm.raised && alarm.severity, UNSEEN.has(alarm.state) && "unseen"].filter(Boolean).join(" ") || null },
      cells: [
        html("div", {}, machine, html("b", {}, alarm.text), html("small", {}, ` ${alarm.name}`), !this.hasAttribute("alarm") && alarm.evidence && html("a", { href: whyOf(place, alarm) }, "Why?")),
        html("div", { class: "states" }, alarm.raised && html("state-mark", { state: alarm.severity }), html("span", {}, alarm.pending ? "pending" : alarm.state)),
        html("time", { class: "number" }, clock(alarm.raised_ns ?? alarm.since_ns)),
        html("span", {}, known(alarm)),
        html("div", { class: "actions" }, ...buttons),
      ],
    };
  }

  /** @param {string} place @param {Alarm} alarm @param {string} kind */
  async #operate(place, alarm, kind) {
    const order = await ordered(kind, `${place}: ${alarm.text}`);
    if (!order) return;
    try {
      await monitor.operate(place, alarm, kind, order);
      this.#message.textContent = `${place}: ${alarm.text}: ${kind} done.`;
    } catch (error) {
      this.#message.textContent = `Not done. ${error instanceof Refused ? error.message : String(error)}`;
    }
  }
}

customElements.define("alarm-list", AlarmList);
