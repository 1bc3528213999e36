import { stretch } from "../monitor/figures.js";
import { machineFile } from "../machine/machine-file.js";
import { monitor, pathOf } from "../monitor/monitor.js";
import { LiveElement } from "./live-element.js";

/**
 * An element about the machine that its attribute `place` names; `show` is called whenever that is heard of. With an attribute `recorded`, what it asks for is
 * of a recorded window instead of what is live: arguments of the API such as `replay=ID&until_ns=TIME`.
 */
export class MachineElement extends LiveElement {
  static observedAttributes = ["recorded"];
  /** @type {import("../monitor/records.d.ts").Health | undefined} */
  #instead;
  /** Whether `show` needs all that is known of the latest window. */
  needsWhole = true;
  /** Whether `show` needs the machine file, which is then asked for. */
  needsFile = false;
  /** The machine file; null before it is there. @type {import("../machine/machine-file.js").MachineFile | null} */
  file = null;

  connectedCallback() {
    super.connectedCallback();
    this.follow(`health:${this.place}`, () => this.show());
    this.show();
    if (this.needsFile) this.load();
  }

  async ask() {
    if (!this.needsFile) return;
    this.file = await this.machineFile();
    this.show();
  }

  /** The machine file as it is in use. */
  machineFile() {
    return machineFile(this.place, this.health?.machine_hash);
  }

  attributeChangedCallback() {
    if (this.isConnected) this.load();
  }

  /** What is recorded does not change, and is asked for until it is there. @param {number} every_s */
  keepLoading(every_s) {
    this.repeat(every_s, () => (this.recorded && this.answered) || this.load());
    this.load();
  }

  get recorded() {
    return this.getAttribute("recorded") ?? "";
  }

  /** What the API has of the machine, live or recorded. @param {string} route @param {string} [wanted] */
  askFor(route, wanted = "") {
    return monitor.ask(`${pathOf(this.place)}/${route}?${[wanted, this.recorded].filter(Boolean).join("&")}`);
  }

  /** Says of a recorded window that it is one, and which. @param {{start_ns: number | null, end_ns: number | null}} found */
  windowText({ start_ns, end_ns }) {
    if (!this.recorded) return "";
    return start_ns === null || end_ns === null ? "Replay" : `Replay, window ${stretch(start_ns, end_ns)}`;
  }

  /** `site/machine` */
  get place() {
    return this.getAttribute("place") ?? "";
  }

  /** Show this and nothing that is live: a window of a replay. @param {import("../monitor/records.d.ts").Health} health */
  feed(health) {
    this.#instead = health;
    this.show();
  }

  /** What was heard last, or what is shown instead; undefined before the first. */
  get health() {
    const heard = this.recorded ? undefined : monitor.machines.get(this.place);
    return this.#instead ?? (heard && (heard.whole || !this.needsWhole) ? heard.health : undefined);
  }

  /** Lay out what is known. */
  show() {}
}
