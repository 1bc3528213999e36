import { clock, stretch } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";
import { counted } from "./replay-list.js";
import "./window-plots.js";

const FOLLOW_MS = 15_000;

/** @import { ReplayJob } from "../monitor/records.d.ts" */

/** Controls of a paced replay on the network: pause, resume, seek. */
class PacedControl extends LiveElement {
  #said = html("p", { class: "number" });
  #pause = html("button", { type: "button", click: () => this.#order(this.#job?.state === "paused" ? "resume" : "pause") });
  #seek = /** @type {HTMLInputElement} */ (html("input", { type: "range", min: 0, max: 1, step: "any", "aria-label": "Place in the data", input: () => { this.#tell(); this.#follow(true); }, change: () => this.#order("seek", { to_ns: Math.round(this.#at()) }) }));
  #place = html("output", { class: "number" });
  message = html("p", { class: "message", role: "alert" });
  #tools = html("div", { class: "scrubber" });
  #plots = /** @type {any} */ (null);
  #followed = -Infinity;
  /** @type {ReplayJob | null} */
  #job = null;
  /** Time span of the data, ns. @type {[number, number] | null} */
  #span = null;
  #held = false;
  /** Orders are sent one after the other, because two at once might be executed in the wrong order. */
  #orders = Promise.resolve();
  #waiting = 0;

  connectedCallback() {
    super.connectedCallback();
    const step = (/** @type {number} */ by_s, /** @type {string} */ text) => html("button", { type: "button", click: () => this.#order("seek", { by_s }) }, text);
    lay(this.#tools, this.#pause, step(-10, "− 10 s"), step(10, "+ 10 s"), this.#seek, this.#place);
    for (const [kind, held] of /** @type {[string, boolean][]} */ ([["pointerdown", true], ["pointerup", false], ["pointercancel", false]])) this.#seek.addEventListener(kind, () => { this.#held = held; });
    lay(this, this.#said, this.#tools, this.message, html("h2", {}, "Progress"));
  }

  /** @param {ReplayJob} job */
  async show(job) {
    const first = !this.#job;
    this.#job = job;
    const running = job.state === "running" || job.state === "paused";
    this.#tools.hidden = !running || !monitor.may("operate");
    this.#pause.textContent = job.state === "paused" ? "Resume" : "Pause";
    lay(this.#said, `It publishes below ${job.prefix}, at ${job.pace} seconds of data per second, and evaluates nothing. A monitor for it: `, html("code", {}, `rotorwatch run --namespace ${job.prefix}`), job.progress ? `. It stands at ${clock(job.progress.position_ns)}, ${counted(job.progress.messages, "message")} sent.` : ".");
    if (first) {
      this.append((this.#plots = html("window-plots", { place: job.recordings[0].split("/").slice(0, 2).join("/"), replay: job.id })));
      await this.attempt(() => this.#measure(job));
    }
    this.#stand();
  }

  /** Move the slider to the replay's position, unless the user is moving it. */
  #stand() {
    const progress = this.#job?.progress;
    if (this.#held || this.#waiting || !progress || !this.#span) return;
    this.#seek.value = String((progress.position_ns - this.#span[0]) / (this.#span[1] - this.#span[0]));
    this.#tell();
    this.#follow(this.#job?.state !== "running");
  }

  /** Show the window that ends at the slider; while the replay is running, only at intervals. @param {boolean} rests */
  #follow(rests) {
    if (!this.#span || (!rests && performance.now() - this.#followed < FOLLOW_MS)) return;
    this.#followed = performance.now();
    this.#plots?.stand(this.#at());
  }

  /** Time span of the replay's data. @param {ReplayJob} job */
  async #measure(job) {
    const all = await Promise.all(job.recordings.slice(0, 50).map((id) => monitor.ask(`${API}/recordings/${id}`)));
    const from = Math.max(job.from_ns ?? 0, Math.min(...all.map((one) => one.data_start_ns)));
    this.#span = [from, Math.min(job.to_ns ?? Infinity, Math.max(...all.map((one) => one.data_end_ns)))];
    this.#seek.setAttribute("aria-label", `Place in the data, ${stretch(...this.#span)}`);
  }

  #at() {
    const [from, to] = this.#span ?? [0, 0];
    return from + Number(this.#seek.value) * (to - from);
  }

  #tell() {
    this.#place.textContent = clock(this.#at());
    this.#seek.setAttribute("aria-valuetext", clock(this.#at()));
  }

  /** @param {string} kind @param {unknown} [order] */
  #order(kind, order) {
    let before = this.#job?.progress;
    this.#held = false;
    this.#waiting += 1;
    this.#orders = this.#orders
      .then(() => monitor.order(`${API}/replays/${this.#job?.id}/${kind}`, order))
      .then((job) => {
        this.message.textContent = "";
        const { state, progress } = this.#job ?? job; // the answer does not yet have the new position
        return state === "running" || state === "paused" ? this.show({ ...job, progress }) : undefined;
      })
      .catch((error) => {
        this.message.textContent = error instanceof Error ? error.message : String(error);
        before = undefined;
      })
      .finally(() => {
        this.#waiting -= 1;
        if (this.#job?.progress !== before) this.#stand();
      });
  }
}

customElements.define("paced-control", PacedControl);
