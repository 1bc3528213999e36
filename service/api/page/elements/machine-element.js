import { monitor } from "../monitor/monitor.js";
import { LiveElement } from "./live-element.js";

/** An element about the machine that its attribute `place` names; `show` is called whenever that is heard of. */
export class MachineElement extends LiveElement {
  connectedCallback() {
    super.connectedCallback();
    this.follow(`health:${this.place}`, () => this.show());
    this.show();
  }

  /** `site/machine` */
  get place() {
    return this.getAttribute("place") ?? "";
  }

  /** What was heard last; undefined before the first. */
  get health() {
    return monitor.machines.get(this.place)?.health;
  }

  /** Lay out what is known. */
  show() {}
}
