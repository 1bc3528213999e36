import { clock } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { monitor, pathOf } from "../monitor/monitor.js";
import "../alarms/alarm-history.js";
import "../alarms/alarm-list.js";
import "./data-quality.js";
import "./level-table.js";
import "../plots/orbit-plot.js";
import "./parameter-forest.js";
import "./parameter-table.js";
import "./parameter-trend.js";
import "../plots/plot-fold.js";
import "../drawing/rotor-drawing.js";
import "../plots/spectrum-plot.js";
import "../elements/state-mark.js";

const RANGES = /** @type {[string, string][]} */ ([["1", "last hour"], ["24", "last 24 h"], ["720", "last 30 days"], ["", "all data"]]);
const RAW = ["health", "reports", "alarms", "alarms/events", "detectable", "configuration"];

/** Folded parts that are loaded when opened: element and heading. */
const FOLDED = [
  ["waveform-plot", "Waveform"],
  ["vector-plot", "1× over speed: Bode and polar"],
  ["waterfall-plot", "Waterfall"],
  ["full-spectrum-plot", "Full spectrum"],
  ["centreline-plot", "Shaft centreline"],
  ["correlation-plot", "Correlations and residuals of the equations"],
];

/** The view of one machine. */
class MachineView extends MachineElement {
  #head = html("div", { class: "head" });
  #built = false;

  connectedCallback() {
    super.connectedCallback();
    document.title = `${this.place} · rotorwatch`;
  }

  show() {
    const health = this.health;
    if (!health) {
      this.#built = false;
      const awaited = monitor.watched?.has(this.place) ?? true;
      return lay(this, html("h1", {}, this.place), html("p", { class: "note" }, awaited ? "Loading …" : "The monitor has no machine of this name."));
    }
    if (!this.#built) this.#build();
    const { report, stream } = health;
    const read = report?.verdict?.outside_model || report?.parameters.some((one) => one.relative_change !== null);
    const levelsAlone = report?.verdict && !read && !report.shapes.length && !report.reason;
    const said = levelsAlone ? "Nothing is diagnosed on this machine: its vibration levels are compared with those of the healthy recordings." : report?.verdict && `${report.verdict.text}.${report.suspect ? ` Best explained by: ${report.suspect}.` : ""}`;
    const silent = stream.silent && health.state !== "no-data";
    lay(
      this.#head,
      html("div", { class: "tools" }, html("h1", {}, html("small", {}, `${health.site}/`), health.machine), html("div", { class: "states" }, html("state-mark", { state: health.state }), silent && html("state-mark", { state: "no-data" }), silent && html("span", {}, `since ${clock(stream.silent_since_ns)}; last known: ${health.state}`))),
      html("p", { class: "reason" }, health.reason),
      html("p", { class: "verdict" }, said),
      html("ul", {}, ...[...(report?.sensors ?? []).map((one) => html("li", {}, one.text))]),
      this.#shapes(),
    );
  }

  /** Shapes of the channels, for machines whose equations cannot be evaluated, and natural frequencies that are watched. */
  #shapes() {
    const { shapes = [], natural_frequencies: frequencies = [] } = this.health?.report ?? {};
    /** @param {string} text @param {{text: string}[]} found */
    const listed = (text, found) => found.length > 0 && html("div", {}, html("p", {}, text), html("ul", {}, ...found.map((one) => html("li", {}, one.text))));
    return html("div", {}, listed("Each channel compared with its own healthy shape; no part of the machine can be named:", shapes), listed("Natural frequencies, watched because a stiffness is read badly or not at all:", frequencies));
  }

  #build() {
    this.#built = true;
    const place = this.place;
    // If parameters are read, levels are less important.
    const trends = [html("parameter-trend", { place, hours: "24" }), html("plot-fold", { place, shows: "machine/level-trend", heading: "Levels over time", hours: "24", open: !this.health?.report?.parameters.length })];
    const range = html(
      "select",
      {
        "aria-label": "Range of the trends",
        change: (event) => {
          for (const trend of trends) trend.setAttribute("hours", event.target.value);
          for (const trend of this.querySelectorAll("parameter-trend, level-trend")) {
            trend.setAttribute("hours", event.target.value);
            /** @type {any} */ (trend).load();
          }
        },
      },
      ...RANGES.map(([hours, text]) => html("option", { value: hours, selected: hours === "24" }, text)),
    );
    lay(
      this,
      html("div", { class: "top" }, this.#head, html("rotor-drawing", { place }), html("alarm-list", { place })),
      html("parameter-table", { place }),
      html("parameter-forest", { place }),
      html("level-table", { place }),
      html("label", { class: "range" }, "Trends: ", range),
      ...trends,
      html("orbit-plot", { place }),
      html("spectrum-plot", { place }),
      ...FOLDED.map(([shows, heading]) => html("plot-fold", { place, shows: `plots/${shows}`, heading })),
      html("data-quality", { place }),
      html("alarm-history", { place }),
      html("plot-fold", { place, shows: "machine/machine-facts", heading: "Machine file" }),
      html("p", { class: "note" }, "From the API: ", ...RAW.flatMap((part, at) => [at ? ", " : "", html("a", { href: `${pathOf(place)}/${part}` }, part)])),
    );
  }
}

customElements.define("machine-view", MachineView);
