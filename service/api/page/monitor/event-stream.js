/** @typedef {{kind: "start" | "overview" | "health" | "alarm" | "lost" | "ended" | "renewed", text: string, at: number}} Told what is told: `at` is when it came, ms since 1970; the text of start names the machines; lost is tried again by the browser, ended is not */
/** @typedef {(told: Told) => void} Listener */
/** @typedef {"listen" | "look" | "leave" | "renew"} Order */

/** Machines that everything may be asked of at once. */
const MOST = 64;
/** Machines that the start of a stream names: its id says of each how far it has been heard. @param {string} text */
export const named = (text) => new Set(text.split(",").map((entry) => entry.split("=")[0]));
/** Characters of what has been heard that are sent along: it names every machine, and an address may not be any length. Health is told anew without, too. */
const LONGEST = 4000;

/** The monitor's stream of events for several listeners: who comes later is told first what was told last of each machine, and of the machine that a listener looks at everything. */
export class EventStream {
  /** @type {Map<Listener, string>} with the machine that each looks at */
  #listeners = new Map();
  /** @type {Set<string>} machines that everything is told of */
  #inFull = new Set();
  /** How far the stream has been heard. */
  #heard = "";
  /** @type {EventSource | null} */
  #source = null;
  /** @type {Told | null} whether it is there */
  #state = null;
  /** @type {Map<string, Told>} */
  #latest = new Map();

  /** Be told of another sign-in. @param {Listener} listener */
  join(listener) {
    this.#listeners.set(listener, "");
  }

  /** Be told what happens, from the beginning. @param {Listener} listener @param {string} place */
  listen(listener, place) {
    this.#listeners.set(listener, place);
    if (this.#source && this.#state) for (const told of [this.#state, ...this.#latest.values()]) listener(told);
    this.look(listener, place);
    if (!this.#source) this.#begin();
  }

  /** Be told everything of this machine. @param {Listener} listener @param {string} place */
  look(listener, place) {
    this.#listeners.delete(listener); // to the end: of very many places, the latest are told in full
    this.#listeners.set(listener, place);
    if (!this.#source || !place || this.#inFull.has(place)) return;
    this.#source.close();
    this.#begin();
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
    for (const each of this.#listeners.keys()) if (each !== listener) each(told);
  }

  #begin() {
    this.#inFull = new Set([...new Set([...this.#listeners.values()].filter(Boolean))].slice(-MOST));
    const asked = new URLSearchParams([["detail", "overview"], ...[...this.#inFull].map((place) => ["in_full", place])]);
    if (this.#heard && this.#heard.length <= LONGEST) asked.set("last_event_id", this.#heard);
    const source = new EventSource(`/api/v1/events?${asked}`);
    this.#source = source;
    for (const kind of /** @type {const} */ (["start", "overview", "health", "alarm"]))
      source.addEventListener(kind, (event) => {
        this.#heard = event.lastEventId;
        this.#tell(kind, kind === "start" ? event.lastEventId : event.data);
      });
    source.addEventListener("error", () => {
      const ended = source.readyState === EventSource.CLOSED;
      if (ended) this.#end();
      this.#tell(ended ? "ended" : "lost", "");
    });
  }

  #end() {
    this.#source?.close();
    [this.#source, this.#state, this.#heard] = [null, null, ""];
    this.#latest.clear();
  }

  /** @param {Told["kind"]} kind @param {string} text */
  #tell(kind, text) {
    const told = { kind, text, at: Date.now() };
    if (kind === "start" || kind === "lost") this.#state = told;
    if (kind === "start") {
      const there = named(text);
      for (const place of this.#latest.keys()) if (!there.has(place)) this.#latest.delete(place);
    }
    if (kind === "overview" || kind === "health") {
      const { site, machine } = JSON.parse(text);
      this.#latest.set(`${site}/${machine}`, told);
    }
    for (const each of this.#listeners.keys()) each(told);
  }
}
