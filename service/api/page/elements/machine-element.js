import { monitor } from "../monitor/monitor.js";
import { LiveElement } from "./live-element.js";

/** An element about the machine that its attribute `place` names; `show` is called whenever that is heard of. */
export class MachineElement extends LiveElement {
  /** @type {import("../monitor/records.js").Health | undefined} */
  #instead;
  /** Whether `show` needs all that is known of the latest window. */
  needsWhole = true;

  connectedCallback() {
    super.connectedCallback();
    this.follow(`health:${this.place}`, () => this.show());
    this.show();
  }

  /** `site/machine` */
  get place() {
    return this.getAttribute("place") ?? "";
  }

  /** Show this and nothing that is live: a window of a replay. @param {import("../monitor/records.js").Health} health */
  feed(health) {
    this.#instead = health;
    this.show();
  }

  /** What was heard last; undefined before the first. */
  get health() {
    const heard = monitor.machines.get(this.place);
    return this.#instead ?? (heard && (heard.whole || !this.needsWhole) ? heard.health : undefined);
  }

  /** Lay out what is known. */
  show() {}
}
