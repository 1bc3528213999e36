import { stretch } from "../monitor/figures.js";
import { machineFile } from "../machine/machine-file.js";
import { monitor, pathOf } from "../monitor/monitor.js";
import { LiveElement } from "./live-element.js";

/**
 * An element about the machine named in its attribute `place`; `show` is called whenever the machine's health arrives. With an attribute `recorded`, it requests
 * a recorded window instead of live data: arguments of the API such as `replay=ID&until_ns=TIME`.
 */
export class MachineElement extends LiveElement {
  static observedAttributes = ["recorded"];
  /** @type {import("../monitor/records.d.ts").Health | undefined} */
  #instead;
  /** Whether `show` needs the complete health, with the whole report of the latest window. */
  needsWhole = true;
  /** Whether `show` needs the machine file, which is then requested. */
  needsFile = false;
  /** The machine file; null until it is loaded. @type {import("../machine/machine-file.js").MachineFile | null} */
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

  /** Load the machine file in use. */
  machineFile() {
    return machineFile(this.place, this.health?.machine_hash);
  }

  attributeChangedCallback() {
    if (this.isConnected) this.load();
  }

  /** Load periodically; recorded data do not change, and are only requested until they have arrived. */
  keepLoading() {
    this.repeat(this.refreshS, () => (this.recorded && this.answered) || this.load());
    this.load();
  }

  get recorded() {
    return this.getAttribute("recorded") ?? "";
  }

  /** Request a route of the machine from the API, live or recorded. @param {string} route @param {string} [wanted] */
  askFor(route, wanted = "") {
    return monitor.ask(`${pathOf(this.place)}/${route}?${[wanted, this.recorded].filter(Boolean).join("&")}`);
  }

  /** Heading that identifies a recorded window. @param {{start_ns: number | null, end_ns: number | null}} found */
  windowText({ start_ns, end_ns }) {
    if (!this.recorded) return "";
    return start_ns === null || end_ns === null ? "Replay" : `Replay, window ${stretch(start_ns, end_ns)}`;
  }

  /** `site/machine` */
  get place() {
    return this.getAttribute("place") ?? "";
  }

  /** Show this health, of a window of a replay, instead of live data. @param {import("../monitor/records.d.ts").Health} health */
  feed(health) {
    this.#instead = health;
    this.show();
  }

  /** The latest health, or the one shown instead; undefined before the first. */
  get health() {
    const heard = this.recorded ? undefined : monitor.machines.get(this.place);
    return this.#instead ?? (heard && (heard.whole || !this.needsWhole) ? heard.health : undefined);
  }

  /** Show the health. */
  show() {}
}
