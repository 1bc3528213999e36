import { html } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { stretch } from "../monitor/figures.js";
import { monitor } from "../monitor/monitor.js";

const RECORDINGS = 40;

/** @import { Sensor } from "../machine/machine-file.js" */
/** @typedef {{source: string, reason: string}} Values */

/**
 * A plot of live samples, of a recording of the machine, or of samples before the end of a recorded window; one line states what is shown and its time.
 * Recorded data do not change, and are requested once.
 * @template {Values} T
 */
export class SamplePlot extends MachineElement {
  /** Route of the API. */
  route = "";
  /** Name of the source if no recording is selected. */
  live = "newest samples";
  refreshS = 15;
  /** @type {Sensor[]} */
  sensors = [];
  body = html("div");
  channel = choiceOf("Channel", () => this.load());
  message = html("p", { class: "note", role: "status" });
  #shown = "";
  /** @type {Map<string, HTMLElement>} */
  #charts = new Map();
  #source = /** @type {HTMLSelectElement} */ (html("select", { "aria-label": "Samples of", change: () => this.load() }));

  connectedCallback() {
    this.#source.replaceChildren(html("option", { value: "" }, this.live));
    this.#source.hidden = true;
    this.replaceChildren(html("div", { class: "tools" }, ...this.choices(), this.#source), this.message, this.body);
    if (!this.recorded) this.#offer();
    super.connectedCallback(); // requests with what is chosen above
  }

  /**
   * Show charts side by side; a chart stays the same element as long as its name does.
   * @param {{name: string, more?: string, said: string, drawing: import("../elements/line-chart.js").Drawing}[]} charts
   */
  lines(charts) {
    const names = charts.map((one) => one.name);
    if (names.join() !== [...this.#charts.keys()].join()) {
      this.#charts = new Map(names.map((name) => [name, html("figure", {}, html("figcaption"), html("line-chart", { role: "img" }))]));
      this.body.replaceChildren(html("div", { class: "charts" }, ...this.#charts.values()));
    }
    for (const { name, more, said, drawing } of charts) {
      const [caption, chart] = /** @type {any} */ (this.#charts.get(name)).children;
      caption.replaceChildren(name, html("small", { class: "number" }, ` ${more ?? ""}`));
      chart.setAttribute("aria-label", said);
      chart.draw(drawing);
    }
  }

  /** Further controls. @returns {HTMLElement[]} */
  choices() {
    return [];
  }

  /** Offer channels or locations as soon as they are known. */
  offer() {
    offered(this.channel, this.sensors.map((one) => one.name));
  }

  /** Arguments of the request. @returns {[string, string][]} */
  asked() {
    return [];
  }

  /** Show the data, and return a description of them. @param {T} _found @returns {string} */
  draw(_found) {
    return "";
  }

  /** @returns {Promise<void>} */
  async ask() {
    if (!this.sensors.length) {
      this.sensors = (await this.machineFile()).sensors.filter((one) => one.quantity !== "shaft_angle");
      this.offer();
    }
    const asked = this.#wanted();
    if (this.#source.value && asked === this.#shown) return;
    if (this.#source.value) this.message.textContent = "The recording is being read …";
    const found = /** @type {T} */ (await this.askFor(this.route, asked));
    if (asked !== this.#wanted()) return this.ask(); // the selection has changed meanwhile
    this.#shown = asked;
    const said = [this.recorded && "Replay", this.draw(found), found.reason].filter(Boolean).join("; ");
    this.message.textContent = said.charAt(0).toUpperCase() + said.slice(1);
  }

  #wanted() {
    const recording = this.#source.value;
    return new URLSearchParams([...this.asked(), ...(recording ? [["recording", recording]] : [])]).toString();
  }

  /** The newest recordings; empty if none are kept. */
  async #offer() {
    const [site, machine] = this.place.split("/");
    try {
      const found = (await monitor.ask(`/api/v1/recordings?${new URLSearchParams({ site, machine, latest: String(RECORDINGS), data_times: "true" })}`)).recordings;
      const whole = /** @type {import("../monitor/records.d.ts").RecordingEntry[]} */ (found).filter((one) => one.data_start_ns !== null).reverse();
      this.#source.append(...whole.map((one) => html("option", { value: one.id.split("/")[2] }, `recorded ${stretch(Number(one.data_start_ns), Number(one.data_end_ns))}${one.kept_because ? ", kept for an alarm" : ""}`)));
      this.#source.hidden = !whole.length;
    } catch {
      this.#source.hidden = true;
    }
  }
}

/** A selection of names; a change causes a new request. @param {string} label @param {() => void} changed */
export const choiceOf = (label, changed) => /** @type {HTMLSelectElement} */ (html("select", { "aria-label": label, change: changed }));

/** Offer names, with other texts where given. @param {HTMLSelectElement} choice @param {(string | [string, string])[]} names */
export const offered = (choice, names) =>
  choice.replaceChildren(...names.map((name) => html("option", { value: typeof name === "string" ? name : name[0] }, typeof name === "string" ? name : name[1])));
