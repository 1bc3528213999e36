import { clock, interval, percent } from "../monitor/figures.js";
import { html, lay, renew, table } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { monitor, Refused } from "../monitor/monitor.js";
import { byUrgency, UNSEEN } from "../monitor/states.js";
import { ordered } from "./alarm-order.js";
import { why } from "./why-link.js";
import "../elements/state-mark.js";

/** @import { Alarm } from "../monitor/records.d.ts" */
/** @typedef {{place: string, alarm: Alarm}} Placed */

/** Reason why an alarm is silenced, else the size of its change, else its note. @param {Alarm} alarm */
function known(alarm) {
  const { shelf, interval_95: range, relative_change: change } = alarm;
  if (shelf) return `shelved by ${shelf.by} until ${clock(shelf.until_ns)}${shelf.one_shot ? " or until it clears" : ""}: ${shelf.reason}`;
  if (alarm.out_of_service_by) return `taken out of service by ${alarm.out_of_service_by}: ${alarm.out_of_service_reason}`;
  if (alarm.suppressed_by) return `suppressed: ${alarm.suppressed_by}`;
  const size = change !== null && range ? `${percent(change)} (${interval(range)})${alarm.low_confidence ? ", low confidence: another cause is possible" : ""}` : "";
  return [size, alarm.note].filter(Boolean).join("; ");
}

const DONE = /** @type {Record<string, string>} */ ({ acknowledge: "acknowledged", reset: "reset", shelve: "shelved", unshelve: "unshelved", "remove-from-service": "taken out of service", "return-to-service": "returned to service" });

/** @param {Placed} one */
const keyOf = ({ place, alarm }) => `${place} ${alarm.name}`;

/** Start of the alarm's condition. @param {Alarm} alarm */
const came = (alarm) => alarm.raised_ns ?? alarm.since_ns;

/** Actions that an alarm's state allows: order, label of the button, and required scope. @param {Alarm} alarm @returns {[string, string, string, boolean][]} */
function operations(alarm) {
  const silenced = ["shelved", "out-of-service"].includes(alarm.state);
  /** @type {[string, string, string, boolean][]} */
  const all = [
    ["acknowledge", "Acknowledge", "operate", UNSEEN.has(alarm.state)],
    ["reset", "Reset", "operate", alarm.state.startsWith("latched")],
    ["shelve", "Shelve …", "operate", !silenced && alarm.state !== "normal"],
    ["unshelve", "Unshelve", "operate", alarm.state === "shelved"],
    ["remove-from-service", "Take out of service …", "configure", alarm.state !== "out-of-service"],
    ["return-to-service", "Return to service", "configure", alarm.state === "out-of-service"],
  ];
  return all.filter(([, , scope, possible]) => possible && monitor.may(scope));
}

/** Alarms that are not normal, with buttons for actions: of all machines, of one `place="site/machine"`, or one `alarm="k_by"` of it. */
class AlarmList extends LiveElement {
  #said = "";
  #rows = html("div");
  #order = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Order", change: () => this.#show() }, html("option", { value: "" }, "most urgent first"), html("option", { value: "first-out" }, "first out: in order of occurrence")));
  #together = html("div", { class: "tools" });
  /** @type {Set<string>} alarms selected for a common action */
  #chosen = new Set();

  connectedCallback() {
    super.connectedCallback();
    const place = this.getAttribute("place");
    this.follow(place ? `health:${place}` : "health", () => this.#show());
    this.follow("connection", () => this.#show());
    lay(this, this.message, !this.hasAttribute("alarm") && this.#together, this.#rows);
    this.#said = "";
    this.#show();
  }

  /** @returns {Placed[]} */
  #alarms() {
    const [only, name] = [this.getAttribute("place"), this.getAttribute("alarm")];
    return [...monitor.machines]
      .filter(([place]) => !only || place === only)
      .flatMap(([place, { health }]) => health.alarms.filter((alarm) => !name || alarm.name === name).map((alarm) => ({ place, alarm })))
      .sort((one, other) => (this.#order.value ? came(one.alarm) - came(other.alarm) : byUrgency(one.alarm, other.alarm)));
  }

  /** Redraw only if something has changed, so that buttons do not move under the pointer. */
  #show() {
    const all = this.#alarms();
    const said = JSON.stringify([all.map(({ place, alarm }) => [place, { ...alarm, evidence: null }]), monitor.caller?.scopes, this.#order.value, [...this.#chosen]]);
    if (said === this.#said) return;
    this.#said = said;
    this.#offer(all);
    const rows = all.map((one) => this.#row(one));
    const heads = ["alarm", "state", "since", "what is known", "actions"];
    renew(this.#rows, rows.length ? table(heads, rows, this.hasAttribute("alarm") ? "Now" : "Alarms that are not normal") : html("p", { class: "note" }, this.hasAttribute("alarm") ? "The alarm is normal now." : "No alarm is raised or waiting to be acknowledged."));
  }

  /** Actions on the selected alarms. @param {Placed[]} all */
  #offer(all) {
    const chosen = all.filter((one) => this.#chosen.has(keyOf(one)));
    const orders = new Map(chosen.flatMap(({ alarm }) => operations(alarm).map(([kind, text]) => [kind, text])));
    renew(
      this.#together,
      all.length > 1 && this.#order,
      ...[...orders].map(([kind, text]) => {
        const able = chosen.filter(({ alarm }) => operations(alarm).some(([one]) => one === kind));
        return html("button", { type: "button", "data-key": `chosen ${kind}`, click: () => this.#operate(able, kind) }, `${text} (${able.length})`);
      }),
    );
  }

  /** @param {Placed} one */
  #row(one) {
    const { place, alarm } = one;
    const key = keyOf(one);
    const choose = (/** @type {Event} */ { target }) => {
      if (/** @type {HTMLInputElement} */ (target).checked) this.#chosen.add(key);
      else this.#chosen.delete(key);
      this.#show();
    };
    const several = !this.hasAttribute("alarm") && operations(alarm).length > 0;
    const box = several && html("input", { type: "checkbox", "aria-label": `choose ${place}: ${alarm.text}`, checked: this.#chosen.has(key), "data-key": `choose ${key}`, change: choose });
    const machine = this.hasAttribute("place") ? null : html("a", { href: `#/machines/${place}` }, place);
    const buttons = operations(alarm).map(([kind, text]) =>
      html("button", { type: "button", "data-key": `${place} ${alarm.name} ${kind}`, click: () => this.#operate([one], kind) }, text),
    );
    return {
      key,
      attributes: { class: [alarm.raised && alarm.severity, UNSEEN.has(alarm.state) && "unseen"].filter(Boolean).join(" ") || null },
      cells: [
        html("div", {}, box, machine, html("b", {}, alarm.text), html("small", {}, ` ${alarm.name}`), !this.hasAttribute("alarm") && why(place, alarm)),
        html("div", { class: "states" }, alarm.raised && html("state-mark", { state: alarm.severity }), html("span", {}, alarm.pending ? "pending" : alarm.state)),
        html("time", { class: "number" }, clock(alarm.raised_ns ?? alarm.since_ns)),
        html("span", { class: "wordy" }, known(alarm)),
        html("div", { class: "actions" }, ...buttons),
      ],
    };
  }

  /** Apply an action to alarms one after the other, each only if it has not changed since it was shown. @param {Placed[]} all @param {string} kind */
  async #operate(all, kind) {
    const order = await ordered(kind, all.map(({ place, alarm }) => `${place}: ${alarm.text}`).join("; "));
    if (!order) return;
    const said = [];
    for (const one of all) {
      const what = `${one.place}: ${one.alarm.text}`;
      try {
        await monitor.operate(one.place, one.alarm, kind, order);
        said.push(`${what}: ${DONE[kind]}.`);
        this.#chosen.delete(keyOf(one));
      } catch (error) {
        said.push(`${what}: not done. ${error instanceof Refused ? error.message : String(error)}`);
      }
    }
    this.message.textContent = said.join(" ");
    this.#show();
  }
}

customElements.define("alarm-list", AlarmList);
