/** The page's model of the monitor: loaded over HTTP, and kept up to date by the event stream. */

import { EventStream, named } from "./event-stream.js";

/** @import { Alarm, Health } from "./records.d.ts" */

export const API = "/api/v1";
const AGAIN_MS = 5_000;
const TOGETHER_MS = 100;

/** A request was refused; the message is the problem's detail. */
export class Refused extends Error {
  /** @param {number} status @param {string} detail @param {any} [body] */
  constructor(status, detail, body = {}) {
    super(detail);
    this.status = status;
    this.body = body;
  }
}

/**
 * The event stream shared by all pages of a browser (SharedWorker); an own stream if the browser does not support that.
 * @param {import("./event-stream.js").Listener} hear
 * @returns {(order: import("./event-stream.js").Order, place: string) => void}
 */
function sharedStream(hear) {
  if (!("SharedWorker" in window)) {
    const own = new EventStream();
    return (order, place) => own[order](hear, place);
  }
  const { port } = new SharedWorker(new URL("./shared-stream.js", import.meta.url), { type: "module" });
  port.onmessage = ({ data }) => hear(data);
  return (order, place) => port.postMessage({ order, place });
}

/** @param {string} place */
export const pathOf = (place) => `${API}/machines/${place}`;

/**
 * Dispatches `health:SITE/MACHINE`; `health` for any machine, at most ten times a second; `alarm`; `connection`; and `caller` when the signed-in caller changes.
 */
export class Monitor extends EventTarget {
  /** Latest health of each machine, with the whole report of its latest window or only its most critical reading. @type {Map<string, {health: Health, heard: number, whole: boolean}>} */
  machines = new Map();
  /** Monitored machines; null until they are known. @type {Set<string> | null} */
  watched = null;
  /** @type {{name: string, scopes: string[]} | null} the signed-in caller */
  caller = null;
  /** Why a sign-in is required; empty if none is. */
  stranger = "";
  connected = false;
  /** @type {number | null} time since which the connection is lost */
  lostAt = null;
  /** Message if a view cannot be loaded. */
  get unloaded() {
    return this.connected ? "The monitor now serves a newer page: reload this one." : "There is no connection to the monitor, and this view has not been loaded yet: reload the page once the monitor can be reached.";
  }
  #tellStream = sharedStream((told) => this.#hear(told));
  #looked = "";
  #due = 0;

  constructor() {
    super();
    addEventListener("pagehide", () => this.#order("leave"));
    addEventListener("pageshow", ({ persisted }) => persisted && this.listen());
  }

  /** Start listening, now and whenever the stream has ended. */
  async listen() {
    try {
      this.#known(await this.ask(`${API}/caller`), "");
    } catch (error) {
      if (error instanceof Refused && error.status === 401) return this.#known(null, error.message);
      this.#lost(error instanceof Error ? error.message : String(error));
      setTimeout(() => this.listen(), AGAIN_MS);
      return;
    }
    this.#order("listen");
  }

  /** Receive the complete health of one machine; with an empty place, of none. @param {string} place */
  look(place) {
    this.#looked = place;
    this.#order("look");
  }

  /** @param {import("./event-stream.js").Order} order */
  #order(order) {
    this.#tellStream(order, this.#looked);
  }

  /** @param {import("./event-stream.js").Told} told */
  #hear({ kind, text, at }) {
    if (kind === "start") this.#found(text);
    else if (kind === "health" || kind === "overview") this.#health(JSON.parse(text), at - performance.timeOrigin, kind === "health");
    else if (kind === "alarm") this.#tell("alarm", JSON.parse(text).data);
    else if (kind === "renewed") {
      this.machines.clear();
      this.listen();
    } else {
      this.#lost("the event stream has ended");
      if (kind === "ended") setTimeout(() => this.listen(), AGAIN_MS);
    }
  }

  /** Whether the caller may operate alarms, or with `configure` take them out of service. @param {string} scope */
  may(scope) {
    return this.caller?.scopes.includes(scope) ?? false;
  }

  /**
   * Let the browser keep a token, in a cookie that no script can read.
   * @param {string} token
   * @throws {Refused}
   */
  async signIn(token) {
    await this.#session("POST", { Authorization: `Bearer ${token}` });
    this.#order("renew");
    await this.listen();
  }

  async signOut() {
    await this.#session("DELETE");
    this.#order("renew");
    this.machines.clear();
    this.#known(null, "Signed out.");
  }

  /** @param {string} method @param {Record<string, string>} [headers] */
  #session(method, headers = {}) {
    return this.ask(`${API}/session`, { method, headers: { "Content-Type": "application/json", ...headers }, body: "{}" });
  }

  /**
   * @param {string} path
   * @param {RequestInit} [request]
   * @returns {Promise<any>}
   * @throws {Refused}
   */
  async ask(path, request = {}) {
    const answer = await fetch(path, request).catch((error) => {
      throw new Refused(0, `the monitor does not answer (${error.message})`);
    });
    const body = await answer.json().catch(() => ({}));
    if (!answer.ok) throw new Refused(answer.status, body.detail ?? answer.statusText, body);
    return body;
  }

  /** Request something that may not exist; null if it does not. @param {string} path @returns {Promise<any>} @throws {Refused} */
  async find(path) {
    return this.ask(path).catch((error) => {
      if (error instanceof Refused && error.status === 404) return null;
      throw error;
    });
  }

  /** Send an order. @param {string} path @param {unknown} [order] @returns {Promise<any>} */
  order(path, order = {}) {
    return this.ask(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(order) });
  }

  /**
   * Apply an action to an alarm, if it has not changed since it was shown.
   * @param {string} place
   * @param {Alarm} seen
   * @param {string} kind
   * @param {Record<string, unknown>} order
   */
  operate(place, seen, kind, order = {}) {
    return this.ask(`${pathOf(place)}/alarms/${encodeURIComponent(seen.name)}/${kind}`, {
      method: "POST",
      headers: { "Content-Type": "application/json", "If-Match": `"${seen.version}"` },
      body: JSON.stringify(order),
    });
  }

  /** Seconds since the newest known data of a machine; null if none ever arrived. @param {string} place */
  dataAge(place) {
    const known = this.machines.get(place);
    const age = known?.health.stream.data_age_s;
    return known && age !== null && age !== undefined ? age + (performance.now() - known.heard) / 1000 : null;
  }

  /** @param {Health} health @param {number} heard @param {boolean} whole */
  #health(health, heard, whole) {
    const place = `${health.site}/${health.machine}`;
    this.machines.set(place, { health, heard, whole });
    this.#tell(`health:${place}`, place);
    this.#due ||= setTimeout(() => {
      this.#due = 0;
      this.#tell("health", "");
    }, TOGETHER_MS);
  }

  /** @param {{name: string, scopes: string[]} | null} caller @param {string} stranger */
  #known(caller, stranger) {
    [this.caller, this.stranger] = [caller, stranger];
    this.#tell("caller", stranger);
  }

  /** @param {string} text names the machines; those no longer monitored are removed */
  #found(text) {
    this.connected = true;
    this.lostAt = null;
    this.watched = named(text);
    for (const place of [...this.machines.keys(), this.#looked])
      if (!this.watched.has(place)) {
        this.machines.delete(place);
        this.#tell(`health:${place}`, place);
      }
    this.#tell("health", "");
    this.#tell("connection", "");
  }

  /** @param {string} why */
  #lost(why) {
    this.connected = false;
    this.lostAt ??= Date.now();
    this.#tell("connection", why);
  }

  /** @param {string} kind @param {unknown} detail */
  #tell(kind, detail) {
    this.dispatchEvent(new CustomEvent(kind, { detail }));
  }
}

/** The monitor that served this page. */
export const monitor = new Monitor();
