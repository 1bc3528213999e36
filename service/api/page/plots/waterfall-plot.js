import { clock, figure, quantity, stretch } from "../monitor/figures.js";
import { html, svg } from "../elements/markup.js";
import { choiceOf, offered, SamplePlot } from "./sample-plot.js";

/** @import { WaterfallSnapshot as Waterfall } from "../monitor/records.d.ts" */

const DECADES = 3;

/** Label of a row: its time or speed. @param {Waterfall["rows"][number]} row @param {string} over */
const named = (row, over) => (over === "speed" ? `${(Math.abs(row.speed_rad_s ?? 0) * 30 / Math.PI).toFixed(0)} rpm` : clock(row.start_ns).slice(11, 19));

/** Spectra of one channel over time or speed, as shades on a logarithmic scale. @extends {SamplePlot<Waterfall>} */
class WaterfallPlot extends SamplePlot {
  route = "waterfalls";
  #over = choiceOf("Over", () => this.load());

  choices() {
    offered(this.#over, [["time", "over time"], ["speed", "over speed"]]);
    return [this.channel, this.#over];
  }

  /** @returns {[string, string][]} */
  asked() {
    return [["channel", this.channel.value], ["over", this.#over.value]];
  }

  /** @param {Waterfall} found */
  draw(found) {
    const { rows, frequencies_hz: lines } = found;
    this.body.replaceChildren();
    if (!rows.length || !found.start_ns || !found.end_ns) return "";
    const top = Math.max(...rows.flatMap((row) => row.values.map((one) => one ?? 0)));
    const canvas = /** @type {HTMLCanvasElement} */ (html("canvas", { width: lines.length, height: rows.length, role: "img", "aria-label": `waterfall of ${found.channel}` }));
    const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
    context.fillStyle = getComputedStyle(this).getPropertyValue("--ink");
    rows.forEach((row, down) =>
      row.values.forEach((value, across) => {
        context.globalAlpha = Math.min(1, Math.max(0, 1 + Math.log10((value ?? 0) / top || 1e-9) / DECADES));
        context.fillRect(across, rows.length - 1 - down, 1, 1);
      }),
    );
    const step = (lines[lines.length - 1] - lines[0]) / (lines.length - 1);
    const once = rows.flatMap((row, down) => (row.speed_rad_s === null ? [] : [`${(Math.abs(row.speed_rad_s) / (2 * Math.PI) - lines[0]) / step + 0.5},${rows.length - down - 0.5}`]));
    const order = once.length ? svg("svg", { viewBox: `0 0 ${lines.length} ${rows.length}`, preserveAspectRatio: "none", "aria-hidden": "true" }, svg("polyline", { points: once.join(" ") })) : "";
    const ends = [rows[rows.length - 1], rows[Math.floor(rows.length / 2)], rows[0]].map((row) => html("span", {}, named(row, found.over)));
    const along = [0, 0.25, 0.5, 0.75, 1].map((part) => html("span", {}, figure(lines[0] + part * (lines[lines.length - 1] - lines[0]))));
    this.body.append(html("figure", { class: "waterfall" }, html("div", { class: "up number" }, ...ends), canvas, order, html("div", { class: "along number" }, ...along), html("p", { class: "unit" }, "frequency, Hz")));
    return `${found.source}, ${rows.length} spectra of ${found.channel}, ${stretch(found.start_ns, found.end_ns)}; the strongest shade is ${quantity(top, found.unit)}, the weakest a thousandth of it or less, on a logarithmic scale${order ? "; dashed: 1×" : ""}`;
  }
}

customElements.define("waterfall-plot", WaterfallPlot);
