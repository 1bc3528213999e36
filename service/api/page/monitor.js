/** What the page knows of the monitor: asked over HTTP, kept up to date by the stream of events. */

/** @typedef {import("./records.js").Health} Health */
/** @typedef {import("./records.js").Alarm} Alarm */

const API = "/api/v1";
const AGAIN_MS = 5_000;

/** An answer that says what was wrong. */
export class Refused extends Error {
  /** @param {number} status @param {string} detail */
  constructor(status, detail) {
    super(detail);
    this.status = status;
  }
}

/** @param {string} place */
export const pathOf = (place) => `${API}/machines/${place}`;

/**
 * Tells `health` (the detail is the machine), `health:SITE/MACHINE`, `alarm` and `connection`.
 */
export class Monitor extends EventTarget {
  /** @type {Map<string, {health: Health, heard: number}>} */
  machines = new Map();
  /** @type {Set<string>} */
  scopes = new Set();
  name = "";
  connected = false;
  /** @type {number | null} since when nothing is heard */
  lostAt = null;
  /** @type {EventSource | null} */
  #stream = null;

  /** Begin to listen, now and whenever the stream has ended. */
  async listen() {
    try {
      const caller = await this.ask(`${API}/caller`);
      [this.name, this.scopes] = [caller.name, new Set(caller.scopes)];
    } catch (error) {
      this.#lost(error instanceof Error ? error.message : String(error));
      setTimeout(() => this.listen(), AGAIN_MS);
      return;
    }
    const stream = new EventSource(`${API}/events`);
    this.#stream = stream;
    stream.addEventListener("start", () => this.#found());
    stream.addEventListener("health", (event) => this.#health(JSON.parse(event.data)));
    stream.addEventListener("alarm", (event) => this.#tell("alarm", JSON.parse(event.data).data));
    stream.addEventListener("error", () => {
      this.#lost("the stream of events has ended");
      if (stream.readyState !== EventSource.CLOSED) return; // else the browser tries again by itself
      stream.close();
      setTimeout(() => this.listen(), AGAIN_MS);
    });
  }

  /** Whether the caller may operate alarms, or with `configure` take them out of service. @param {string} scope */
  may(scope) {
    return this.scopes.has(scope);
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
    if (!answer.ok) throw new Refused(answer.status, body.detail ?? answer.statusText);
    return body;
  }

  /**
   * Do something to an alarm, if it still is as it was shown.
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

  /** Seconds since the newest data of a machine, as far as is known; null if none ever came. @param {string} place */
  dataAge(place) {
    const known = this.machines.get(place);
    const age = known?.health.stream.data_age_s;
    return known && age !== null && age !== undefined ? age + (performance.now() - known.heard) / 1000 : null;
  }

  /** @param {Health} health */
  #health(health) {
    const place = `${health.site}/${health.machine}`;
    this.machines.set(place, { health, heard: performance.now() });
    this.#tell(`health:${place}`, place);
    this.#tell("health", place);
  }

  #found() {
    this.connected = true;
    this.lostAt = null;
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
