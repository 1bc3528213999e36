import { lasting } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { monitor } from "../monitor/monitor.js";
import { ABNORMAL, stands, UNSEEN, worst } from "../monitor/states.js";
import "../elements/spark-line.js";
import "../elements/state-mark.js";

/** One machine of the plant: its worst standing state, what is worst, and how old that is. */
class MachineTile extends MachineElement {
  /** @type {Element | null} */
  #spark = null;

  connectedCallback() {
    super.connectedCallback();
    this.repeat(5, () => this.age());
  }

  show() {
    const health = this.health;
    if (!health) return;
    const silent = health.stream.silent;
    const found = worst(health);
    const unseen = health.alarms.filter((one) => UNSEEN.has(one.state)).length;
    const standing = health.alarms.filter(stands).length;
    this.className = ABNORMAL.has(health.state) ? `tile ${health.state}` : silent ? "tile no-data" : "tile";
    lay(
      this,
      html("div", { class: "states" }, html("state-mark", { state: health.state }), silent && health.state !== "no-data" && html("state-mark", { state: "no-data" })),
      html("h2", {}, html("a", { href: `#/machines/${this.place}` }, html("small", {}, `${health.site}/`), health.machine)),
      html(
        "p",
        { class: "worst" },
        ...(found ? [html("span", {}, found.title), html("b", { class: "number" }, found.value), html("small", {}, found.limit)] : [html("span", {}, health.reason || "Nothing has been evaluated yet.")]),
      ),
      this.#line(found),
      html("p", { class: "foot" }, html("span", {}, unseen ? `${unseen} unacknowledged` : standing ? `${standing} acknowledged` : "no alarm"), html("span", { class: "age number" })),
    );
    this.age();
  }

  age() {
    const [age, shown] = [monitor.dataAge(this.place), this.querySelector(".age")];
    if (shown) shown.textContent = age === null ? "never any data" : `data ${lasting(age)} old`;
  }

  /** The same element as long as it shows the same series. @param {import("../monitor/states.js").Worst | null} found */
  #line(found) {
    if (!found?.series) return null;
    if (this.#spark?.getAttribute("series") !== found.series)
      this.#spark = html("spark-line", { place: this.place, quantity: found.quantity, series: found.series });
    return this.#spark;
  }
}

customElements.define("machine-tile", MachineTile);
