import { clock, stretch } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";
import { counted, differences, outcome } from "./replay-list.js";
import "./offline-result.js";
import "./paced-control.js";

const ENDED = new Set(["finished", "stopped", "failed"]);

/** @import { ReplayJob } from "../monitor/records.d.ts" */

/** One replay, framed and under a banner, so that nobody takes it for live data. */
class ReplayView extends LiveElement {
  #banner = html("p", { class: "replay-banner" });
  #head = html("div");
  #bar = /** @type {HTMLProgressElement} */ (html("progress", { max: 1, value: 0, "aria-label": "Progress of the replay" }));
  #state = html("p", { role: "status" });
  message = html("p", { class: "message", role: "alert" });
  #stop = html("button", { type: "button", hidden: true, click: () => this.attempt(() => monitor.ask(this.#path, { method: "DELETE" })) }, "Stop");
  #body = html("div");
  /** @type {EventSource | null} */
  #stream = null;
  /** Keeps the scrubber below the banner, which has more lines on a phone. */
  #sized = new ResizeObserver(() => this.style.setProperty("--banner", `${this.#banner.offsetHeight}px`));

  get #path() {
    return `${API}/replays/${this.getAttribute("place")}`;
  }

  connectedCallback() {
    super.connectedCallback();
    lay(this, this.#banner, html("div", { class: "replay-frame" }, this.#head, html("div", { class: "tools" }, this.#state, this.#bar, this.#stop), this.message, this.#body));
    this.#sized.observe(this.#banner);
    this.load();
  }

  disconnectedCallback() {
    super.disconnectedCallback();
    this.#sized.disconnect();
    this.#stream?.close();
  }

  async ask() {
    const job = /** @type {ReplayJob} */ (await monitor.ask(this.#path));
    const [site, machine] = job.recordings[0].split("/");
    const what = `${site}/${machine}`;
    document.title = `Replay of ${what} · rotorwatch`;
    lay(this.#banner, html("b", {}, "REPLAY"), ` of ${what}${job.machine_file_sent ? ` with another machine file, ${job.machine}` : ""}. Nothing in this view is live, and its alarms notify nobody. `, html("a", { href: `#/machines/${what}` }, "The live machine"));
    const times = job.from_ns !== null && job.to_ns !== null ? `, of them ${stretch(job.from_ns, job.to_ns)}` : "";
    lay(
      this.#head,
      html("div", { class: "tools" }, html("h1", {}, "Replay of ", html("small", {}, `${site}/`), machine), html("a", { href: "#/recordings" }, "Recordings")),
      html("p", {}, `${counted(job.recordings.length, "recording")}${times}; ${differences(job) || "as recorded"}; started ${clock(job.started_ns)}.`),
    );
    this.#show(job);
    if (ENDED.has(job.state)) return;
    const stream = new EventSource(`${this.#path}/events`);
    this.#stream = stream;
    stream.addEventListener("progress", (event) => this.#show(JSON.parse(event.data)));
    stream.addEventListener("end", (event) => {
      stream.close();
      this.#show(JSON.parse(event.data));
    });
  }

  /** @param {ReplayJob} job */
  #show(job) {
    const ended = ENDED.has(job.state);
    this.#state.textContent = `${job.state[0].toUpperCase()}${job.state.slice(1)}: ${outcome(job)}.`;
    this.#bar.hidden = ended;
    this.#bar.value = job.progress?.fraction ?? 0;
    this.#stop.hidden = ended || !monitor.may("operate");
    const tag = job.mode === "paced" ? "paced-control" : ended && job.summary ? "offline-result" : "";
    if (tag && this.#body.firstElementChild?.localName !== tag) lay(this.#body, html(tag, { replay: job.id }));
    /** @type {any} */ (this.#body.firstElementChild)?.show(job);
  }
}

customElements.define("replay-view", ReplayView);
