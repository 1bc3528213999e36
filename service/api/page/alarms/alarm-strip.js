import { clock } from "../monitor/figures.js";
import { html, renew } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { monitor } from "../monitor/monitor.js";
import { byUrgency, stands, UNSEEN } from "../monitor/states.js";
import { why } from "./why-link.js";
import "../elements/state-mark.js";

const SHOWN = 5;

/** All standing alarms of all machines. */
export function standing() {
  return [...monitor.machines]
    .flatMap(([place, { health }]) => health.alarms.filter(stands).map((alarm) => ({ place, alarm })))
    .sort((one, other) => byUrgency(one.alarm, other.alarm));
}

/** The most urgent alarms of the plant in a few lines, unacknowledged ones first. */
class AlarmStrip extends LiveElement {
  #said = "";

  connectedCallback() {
    super.connectedCallback();
    this.follow("health", () => this.#show());
    this.#said = "";
    this.#show();
  }

  #show() {
    const all = standing();
    const said = JSON.stringify([all.length, all.slice(0, SHOWN).map(({ place, alarm }) => [place, { ...alarm, evidence: null }])]);
    if (said === this.#said) return;
    this.#said = said;
    const rows = all.slice(0, SHOWN).map(({ place, alarm }) =>
      html(
        "li",
        { class: UNSEEN.has(alarm.state) ? "unseen" : null, "data-key": `${place} ${alarm.name}` },
        html("state-mark", { state: alarm.raised ? alarm.severity : "cleared" }),
        html("a", { href: `#/machines/${place}` }, place),
        html("span", { class: "what" }, alarm.text, " ", why(place, alarm)),
        html("span", { class: "note" }, alarm.state),
        html("time", { class: "number" }, clock(alarm.raised_ns ?? alarm.since_ns)),
      ),
    );
    this.hidden = !all.length;
    renew(
      this,
      html("ul", { "aria-label": "standing alarms" }, ...rows),
      html("a", { href: "#/alarms" }, all.length > SHOWN ? `all ${all.length} standing alarms` : "alarms"),
    );
  }
}

customElements.define("alarm-strip", AlarmStrip);
