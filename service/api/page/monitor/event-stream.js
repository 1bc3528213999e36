/** @typedef {{kind: "start" | "health" | "alarm" | "lost" | "ended" | "renewed", text: string, at: number}} Told what is told: `at` is when it came, ms since 1970; lost is tried again by the browser, ended is not */
/** @typedef {(told: Told) => void} Listener */

/** The monitor's stream of events for several listeners: who comes later is told first what was told last of each machine. */
export class EventStream {
  /** @type {Set<Listener>} */
  #listeners = new Set();
  /** @type {EventSource | null} */
  #source = null;
  /** @type {Told | null} whether it is there */
  #state = null;
  /** @type {Map<string, Told>} */
  #latest = new Map();

  /** Be told of another sign-in. @param {Listener} listener */
  join(listener) {
    this.#listeners.add(listener);
  }

  /** Be told everything, from the beginning. @param {Listener} listener */
  listen(listener) {
    this.#listeners.add(listener);
    if (!this.#source) this.#begin();
    else if (this.#state) for (const told of [this.#state, ...this.#latest.values()]) listener(told);
  }

  /** @param {Listener} listener */
  leave(listener) {
    this.#listeners.delete(listener);
    if (!this.#listeners.size) this.#end();
  }

  /** Somebody else is signed in, or nobody: all but who says so begin again. @param {Listener} listener */
  renew(listener) {
    this.#end();
    const told = /** @type {Told} */ ({ kind: "renewed", text: "", at: Date.now() });
    for (const each of this.#listeners) if (each !== listener) each(told);
  }

  #begin() {
    const source = new EventSource("/api/v1/events");
    this.#source = source;
    for (const kind of /** @type {const} */ (["start", "health", "alarm"])) source.addEventListener(kind, (event) => this.#tell(kind, event.data));
    source.addEventListener("error", () => {
      const ended = source.readyState === EventSource.CLOSED;
      if (ended) this.#end();
      this.#tell(ended ? "ended" : "lost", "");
    });
  }

  #end() {
    this.#source?.close();
    [this.#source, this.#state] = [null, null];
    this.#latest.clear();
  }

  /** @param {Told["kind"]} kind @param {string} text */
  #tell(kind, text) {
    const told = { kind, text, at: Date.now() };
    if (kind === "start" || kind === "lost") this.#state = told;
    if (kind === "health") {
      const { site, machine } = JSON.parse(text);
      this.#latest.set(`${site}/${machine}`, told);
    }
    for (const each of this.#listeners) each(told);
  }
}
