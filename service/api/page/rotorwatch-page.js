import { clock, inches, local, showInches, showLocal } from "./monitor/figures.js";
import { html } from "./elements/markup.js";
import { monitor } from "./monitor/monitor.js";
import { standing } from "./alarms/alarm-strip.js";
import { UNSEEN } from "./monitor/states.js";
import "./plant/plant-view.js";
import "./sign-in.js";

/** Views by the first part of the address after `#/`; those other than the plant are loaded on demand. @type {Record<string, [string, () => Promise<unknown>]>} */
const VIEWS = {
  machines: ["machine-view", () => import("./machine/machine-view.js")],
  alarms: ["alarms-view", () => import("./alarms/alarms-view.js")],
  why: ["why-view", () => import("./alarms/why-view.js")],
  recordings: ["recordings-view", () => import("./recordings/recordings-view.js")],
  replays: ["replay-view", () => import("./recordings/replay-view.js")],
  administration: ["administration-view", () => import("./administration/administration-view.js")],
};

/** The page: its permanent parts, and the view named in the address. */
class RotorwatchPage extends HTMLElement {
  #banner = html("p", { class: "banner", role: "alert", hidden: true });
  #alarms = html("a", { href: "#/alarms" }, "Alarms");
  #administration = html("a", { href: "#/administration", hidden: true }, "Administration");
  #who = html("span", { class: "note" });
  #leave = html("button", { type: "button", hidden: true, click: () => this.#signOut() }, "Sign out");
  #times = html("button", { type: "button", title: "Show times in UTC or in the time of this computer", click: () => this.#switch(showLocal, !local()) });
  #units = html("button", { type: "button", title: "Show lengths and velocities in µm and mm/s, or in mil and in/s", click: () => this.#switch(showInches, !inches()) });
  #main = html("main", { tabindex: "-1", id: "main" });

  connectedCallback() {
    this.replaceChildren(
      html("header", {}, html("a", { href: "#/", class: "brand" }, "rotorwatch"), html("nav", {}, html("a", { href: "#/" }, "Plant"), this.#alarms, html("a", { href: "#/recordings" }, "Recordings"), this.#administration), this.#who, this.#leave, this.#units, this.#times),
      this.#banner,
      this.#main,
      html("footer", {}, "Monitoring, not machine protection. ", html("a", { href: "/docs" }, "HTTP API"), ", ", html("a", { href: "/openapi.json" }, "its description"), ", ", html("a", { href: "/readyz" }, "readiness")),
    );
    addEventListener("hashchange", () => this.#go(true));
    monitor.addEventListener("connection", (event) => this.#connection(/** @type {CustomEvent<string>} */ (event).detail));
    monitor.addEventListener("caller", () => this.#caller());
    monitor.addEventListener("health", () => this.#count());
    this.#count();
    this.#go(false);
    monitor.listen();
  }

  /** @param {boolean} moved */
  async #go(moved) {
    const asked = location.hash;
    const [name, ...rest] = asked.replace(/^#\/?/, "").split("/").map(decodeURIComponent);
    monitor.look(name === "machines" ? rest.join("/") : "");
    const [tag, load] = VIEWS[name] ?? ["plant-view", async () => {}];
    if (!this.#main.firstChild) this.#main.append(html("p", { class: "note" }, "Loading …"));
    try {
      await load();
      if (location.hash !== asked) return; // the user has navigated on meanwhile
    } catch {
      this.#main.replaceChildren(html("p", {}, monitor.unloaded));
      return;
    }
    if (monitor.stranger) return this.#main.replaceChildren(html("sign-in"));
    const view = html(tag, { place: rest.join("/") || null });
    for (const link of this.querySelectorAll("nav a")) {
      if (link.getAttribute("href") === (name === "replays" ? "#/recordings" : location.hash || "#/")) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    this.#main.replaceChildren(view);
    this.#count();
    if (moved) this.#main.focus();
  }

  /** The caller has changed: remove what was shown to the previous one. */
  #caller() {
    this.#who.textContent = monitor.caller?.name ?? "";
    this.#leave.hidden = !monitor.caller || monitor.caller.name === "anonymous";
    this.#administration.hidden = !monitor.may("configure");
    this.#banner.hidden = true;
    if (monitor.stranger || this.querySelector("sign-in")) this.#go(true);
    this.#count();
  }

  async #signOut() {
    try {
      await monitor.signOut();
    } catch (error) {
      this.#connection(error instanceof Error ? error.message : String(error));
    }
  }

  /** @param {(wanted: boolean) => void} show @param {boolean} wanted */
  #switch(show, wanted) {
    show(wanted);
    this.#count();
    this.#go(false);
  }

  /** Show the number of standing alarms in the title and beside the link. */
  #count() {
    const all = standing();
    const unseen = all.filter(({ alarm }) => UNSEEN.has(alarm.state)).length;
    this.#alarms.textContent = all.length ? `Alarms ${all.length}` : "Alarms";
    this.#alarms.classList.toggle("unseen", unseen > 0);
    this.#times.textContent = local() ? "local time" : "UTC";
    this.#units.textContent = inches() ? "mil, in/s" : "µm, mm/s";
    const where = this.querySelector("machine-view")?.getAttribute("place");
    document.title = `${all.length ? `(${unseen ? `${unseen} of ` : ""}${all.length}) ` : ""}${where ? `${where} · ` : ""}rotorwatch`;
  }

  /** @param {string} why */
  #connection(why) {
    this.#banner.hidden = monitor.connected;
    this.classList.toggle("lost", !monitor.connected);
    this.#banner.textContent = monitor.connected ? "" : `No connection to the monitor since ${clock(Number(monitor.lostAt) * 1e6)}: ${why}. What is shown is from before.`;
    this.#count();
  }
}

customElements.define("rotorwatch-page", RotorwatchPage);
