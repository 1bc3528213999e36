/** @typedef {{kind: "start" | "overview" | "health" | "alarm" | "lost" | "ended" | "renewed", text: string, at: number}} Told what is told: `at` is when it came, ms since 1970; the text of start names the machines; lost is tried again by the browser, ended is not */
/** @typedef {(told: Told) => void} Listener */
/** @typedef {"listen" | "look" | "leave" | "renew"} Order */

/** Most machines whose complete health is requested at once. */
const MOST = 64;
/** Machines named at the start of a stream, whose id holds the position in each machine's log. @param {string} text */
export const named = (text) => new Set(text.split(",").map((entry) => entry.split("=")[0]));
/** Longest id that is sent on reconnection: it names every machine, and the length of a URL is limited. Without it, health is still sent anew. */
const LONGEST = 4000;

/** The monitor's event stream, shared by several listeners: a new listener first gets the latest message of each machine, and the complete health of the machine that it looks at. */
export class EventStream {
  /** @type {Map<Listener, string>} with the machine that each looks at */
  #listeners = new Map();
  /** @type {Set<string>} machines whose complete health is received */
  #inFull = new Set();
  /** Id of the last event received. */
  #heard = "";
  /** @type {EventSource | null} */
  #source = null;
  /** @type {Told | null} latest state of the connection */
  #state = null;
  /** @type {Map<string, Told>} */
  #latest = new Map();

  /** Register a listener, which is told of a new sign-in. @param {Listener} listener */
  join(listener) {
    this.#listeners.set(listener, "");
  }

  /** Send events to a listener, starting with the latest messages. @param {Listener} listener @param {string} place */
  listen(listener, place) {
    this.#listeners.set(listener, place);
    if (this.#source && this.#state) for (const told of [this.#state, ...this.#latest.values()]) listener(told);
    this.look(listener, place);
    if (!this.#source) this.#begin();
  }

  /** Send a listener the complete health of a machine. @param {Listener} listener @param {string} place */
  look(listener, place) {
    this.#listeners.delete(listener); // moved to the end: if there are too many places, the latest are sent in full
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

  /** The signed-in caller has changed: all listeners except the one that reports it must start again. @param {Listener} listener */
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
