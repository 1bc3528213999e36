import { html, lay } from "./markup.js";
import { monitor } from "../monitor/monitor.js";

/** An element that listens to the monitor and requests data periodically while it is on the page. */
export class LiveElement extends HTMLElement {
  #gone = new AbortController();
  #loading = false;
  #again = false;
  #unseen = false;
  /** Whether the last request was answered. */
  answered = false;
  /** Seconds between requests; 0 for an element that does not request periodically. */
  refreshS = 0;
  /** Heading of an element that has nothing else to show as long as no request is answered. */
  heading = "";
  /** Says why there are no new data; an element that does not place it in its content is replaced by it. */
  message = html("p", { class: "message", role: "status", "data-key": "message" });

  connectedCallback() {
    this.#gone = new AbortController();
    this.#unseen = false;
    // A load skipped while the page was hidden is done as soon as it is visible.
    document.addEventListener("visibilitychange", () => this.#unseen && !document.hidden && this.load(), { signal: this.#gone.signal });
    if (this.refreshS) this.keepLoading();
  }

  disconnectedCallback() {
    this.#gone.abort();
  }

  /** Listen to the monitor while the element is on the page. @param {string} kind @param {(event: any) => void} hear */
  follow(kind, hear) {
    monitor.addEventListener(kind, hear, { signal: this.#gone.signal });
  }

  /** Call a function periodically while the element is on the page. @param {number} every_s @param {() => void} act */
  repeat(every_s, act) {
    const timer = setInterval(act, 1000 * every_s);
    this.#gone.signal.addEventListener("abort", () => clearInterval(timer));
  }

  /** Load now, and then periodically while the element is on the page. */
  keepLoading() {
    this.repeat(this.refreshS, () => this.load());
    this.load();
  }

  /** Request the data shown: one request at a time, none while the page is hidden; a load wanted meanwhile is done afterwards. */
  async load() {
    this.#unseen = document.hidden;
    this.#again = this.#loading;
    if (this.#loading || document.hidden) return;
    this.#loading = true;
    try {
      this.answered = await this.attempt(() => this.ask());
    } finally {
      this.#loading = false;
      if (this.#again && this.isConnected) this.load();
    }
  }

  /**
   * Do something that the monitor may refuse, and show why.
   * @param {() => Promise<unknown>} act
   * @param {string} [failed] begins the message if it is refused
   * @returns {Promise<boolean>} whether it was done
   */
  async attempt(act, failed = "") {
    try {
      await act();
      return true;
    } catch (error) {
      this.refused(failed + (error instanceof Error ? error.message : String(error)));
      return false;
    }
  }

  /** Request data from the monitor, and show the answer. */
  async ask() {}

  /** Show why there are no new data. @param {string} why */
  refused(why) {
    this.message.textContent = why;
    if (!this.contains(this.message)) lay(this, this.heading && html("h2", {}, this.heading), this.message);
  }
}
