import { lasting } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { monitor } from "../monitor/monitor.js";
import { ABNORMAL, stands, UNSEEN, worst } from "../monitor/states.js";
import "../elements/spark-line.js";
import "../elements/state-mark.js";

const seen = new IntersectionObserver(
  (entries) => {
    for (const { target, isIntersecting } of entries) /** @type {MachineTile} */ (target).seen(isIntersecting);
  },
  { rootMargin: "50%" },
);

/** Tile of one machine: its worst standing state, the most critical reading, and the age of the data. */
class MachineTile extends MachineElement {
  #states = html("div", { class: "states" });
  #worst = html("p", { class: "worst" });
  #line = html("div", { class: "line" });
  #count = html("span");
  #age = html("span", { class: "number" });
  needsWhole = false;
  #near = false;
  #late = false;

  connectedCallback() {
    super.connectedCallback();
    seen.observe(this);
    this.repeat(5, () => this.#near && this.age());
  }

  disconnectedCallback() {
    super.disconnectedCallback();
    seen.unobserve(this);
  }

  /** Tiles far outside the visible area are only updated when they come near, because a plant may have many. @param {boolean} near */
  seen(near) {
    this.#near = near;
    if (near && this.#late) this.show();
  }

  show() {
    const health = this.health;
    if (!health) return;
    this.#late = !this.#near && this.childElementCount > 0;
    if (this.#late) return;
    const silent = health.stream.silent;
    const found = worst(health);
    const unseen = health.alarms.filter((one) => UNSEEN.has(one.state)).length;
    const standing = health.alarms.filter(stands).length;
    this.className = ABNORMAL.has(health.state) ? `tile ${health.state}` : silent ? "tile no-data" : "tile";
    if (!this.childElementCount) lay(this, this.#states, html("h3", {}, html("a", { href: `#/machines/${this.place}` }, html("small", {}, `${health.site}/`), health.machine)), this.#worst, this.#line, html("p", { class: "foot" }, this.#count, this.#age));
    lay(this.#states, html("state-mark", { state: health.state }), silent && health.state !== "no-data" && html("state-mark", { state: "no-data" }));
    lay(this.#worst, ...(found ? [html("span", {}, found.title), html("b", { class: "number" }, found.value), html("small", {}, found.limit)] : [html("span", { title: health.reason }, health.reason || "Nothing has been evaluated yet.")]));
    this.#count.textContent = unseen ? `${unseen} unacknowledged` : standing ? `${standing} acknowledged` : "no alarm";
    const line = this.#line.firstElementChild;
    if ((line?.getAttribute("series") ?? "") !== (found?.series ?? "")) lay(this.#line, found?.series && html("spark-line", { place: this.place, quantity: found.quantity, series: found.series }));
    this.#line.firstElementChild?.setAttribute("range", (found?.range ?? []).join(" "));
    this.age();
  }

  age() {
    const age = monitor.dataAge(this.place);
    this.#age.textContent = age === null ? "no data received yet" : `data ${lasting(age)} old`;
  }
}

customElements.define("machine-tile", MachineTile);
