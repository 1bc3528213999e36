import { monitor } from "../monitor/monitor.js";

/** An element that listens to the monitor and asks it again and again while it is on the page. */
export class LiveElement extends HTMLElement {
  #gone = new AbortController();
  #loading = false;
  #again = false;
  #unseen = false;
  /** Whether what was asked for last has been answered. */
  answered = false;

  connectedCallback() {
    this.#gone = new AbortController();
    this.#unseen = false;
    // Not while nobody looks, but as soon as somebody does.
    document.addEventListener("visibilitychange", () => this.#unseen && !document.hidden && this.load(), { signal: this.#gone.signal });
  }

  disconnectedCallback() {
    this.#gone.abort();
  }

  /** Listen to the monitor while the element is on the page. @param {string} kind @param {(event: any) => void} hear */
  follow(kind, hear) {
    monitor.addEventListener(kind, hear, { signal: this.#gone.signal });
  }

  /** Do something again and again while the element is on the page. @param {number} every_s @param {() => void} act */
  repeat(every_s, act) {
    const timer = setInterval(act, 1000 * every_s);
    this.#gone.signal.addEventListener("abort", () => clearInterval(timer));
  }

  /** Load now, and again and again while the element is on the page. @param {number} every_s */
  keepLoading(every_s) {
    this.repeat(every_s, () => this.load());
    this.load();
  }

  /** Ask for what is shown: never twice at once, nor while nobody looks. What is wanted meanwhile is asked for afterwards. */
  async load() {
    this.#unseen = document.hidden;
    this.#again = this.#loading;
    if (this.#loading || document.hidden) return;
    this.#loading = true;
    try {
      await this.ask();
      this.answered = true;
    } catch (error) {
      this.answered = false;
      this.refused(error instanceof Error ? error.message : String(error));
    } finally {
      this.#loading = false;
      if (this.#again && this.isConnected) this.load();
    }
  }

  /** Ask the monitor, and lay out what it answers. */
  async ask() {}

  /** Say why there is nothing new to be shown. @param {string} _why */
  refused(_why) {}
}
