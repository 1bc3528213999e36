import { clock, local, showLocal } from "./figures.js";
import { html } from "./markup.js";
import { monitor } from "./monitor.js";
import { standing } from "./alarm-strip.js";
import { UNSEEN } from "./states.js";
import "./plant-view.js";

/** Views by the first part of the address after `#/`; what is not needed for the plant is loaded when it is asked for. @type {Record<string, () => Promise<unknown>>} */
const VIEWS = { machines: () => import("./machine-view.js"), alarms: () => import("./alarms-view.js") };

/** The page: what is always there, and the view that the address names. */
class RotorwatchPage extends HTMLElement {
  #banner = html("p", { class: "banner", role: "alert", hidden: true });
  #alarms = html("a", { href: "#/alarms" }, "Alarms");
  #who = html("span", { class: "note" });
  #times = html("button", { type: "button", click: () => this.#switch() });
  #main = html("main", { tabindex: "-1", id: "main" });

  connectedCallback() {
    this.replaceChildren(
      html("header", {}, html("a", { href: "#/", class: "brand" }, "rotorwatch"), html("nav", {}, html("a", { href: "#/" }, "Plant"), this.#alarms), this.#who, this.#times),
      this.#banner,
      this.#main,
      html("footer", {}, "Monitoring, not machine protection. ", html("a", { href: "/docs" }, "HTTP API"), ", ", html("a", { href: "/openapi.json" }, "its description"), ", ", html("a", { href: "/readyz" }, "readiness")),
    );
    addEventListener("hashchange", () => this.#go(true));
    monitor.addEventListener("connection", ({ detail }) => this.#connection(detail));
    monitor.addEventListener("health", () => this.#count());
    this.#count();
    this.#go(false);
    monitor.listen();
  }

  /** @param {boolean} moved */
  async #go(moved) {
    const [name, ...rest] = location.hash.replace(/^#\/?/, "").split("/").map(decodeURIComponent);
    try {
      await VIEWS[name]?.();
    } catch {
      this.#main.replaceChildren(html("p", {}, "The monitor serves another page by now: load this one again."));
      return;
    }
    const view = name === "machines" ? html("machine-view", { place: rest.join("/") }) : html(name === "alarms" ? "alarms-view" : "plant-view");
    for (const link of this.querySelectorAll("nav a")) {
      if (link.getAttribute("href") === (location.hash || "#/")) link.setAttribute("aria-current", "page");
      else link.removeAttribute("aria-current");
    }
    this.#main.replaceChildren(view);
    this.#count();
    if (moved) this.#main.focus();
  }

  #switch() {
    showLocal(!local());
    this.#count();
    this.#go(false);
  }

  /** How many alarms stand, in the title and beside the link. */
  #count() {
    const all = standing();
    const unseen = all.filter(({ alarm }) => UNSEEN.has(alarm.state)).length;
    this.#alarms.textContent = all.length ? `Alarms ${all.length}` : "Alarms";
    this.#alarms.classList.toggle("unseen", unseen > 0);
    this.#times.textContent = local() ? "local time" : "UTC";
    this.#times.title = "Show times in UTC or in the time of this computer";
    const where = this.querySelector("machine-view")?.getAttribute("place");
    document.title = `${all.length ? `(${unseen ? `${unseen} of ` : ""}${all.length}) ` : ""}${where ? `${where} · ` : ""}rotorwatch`;
  }

  /** @param {string} why */
  #connection(why) {
    this.#banner.hidden = monitor.connected;
    this.classList.toggle("lost", !monitor.connected);
    this.#banner.textContent = monitor.connected ? "" : `No connection to the monitor since ${clock(Number(monitor.lostAt) * 1e6)}: ${why}. What is shown is from before.`;
    this.#who.textContent = monitor.name;
    this.#count();
  }
}

customElements.define("rotorwatch-page", RotorwatchPage);
