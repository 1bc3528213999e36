import { figure, printed } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { measuredLines, pairName } from "../plots/correlation-plot.js";
import { orbitFigure } from "../plots/orbit-plot.js";
import { choiceOf, offered } from "../plots/sample-plot.js";
import { spectrumDrawing } from "../plots/spectrum-plot.js";
import "../elements/line-chart.js";

/** @import { CorrelationPair as Pair, Picture } from "../monitor/records.d.ts" */
/** @import { Line } from "../elements/line-chart.js" */

const HEIGHT = 270;
const AFTER = { label: "after", colour: "estimated", width: 2 };
const BEFORE = { label: "before", colour: "nominal", dash: [6, 4], width: 1.5 };

/** Difference of two correlation functions in standard errors (rms over the lags); null if it cannot be computed. @param {Pair | undefined} was @param {Pair} now */
function apart(was, now) {
  if (!was || was.measured.length !== now.measured.length) return null;
  const squares = now.measured.flatMap((value, at) => {
    const error = Math.hypot(now.standard_error[at] ?? NaN, was.standard_error[at] ?? NaN);
    const z = (Number(value) - Number(was.measured[at])) / error;
    return Number.isFinite(z) ? [z * z] : [];
  });
  return squares.length ? Math.sqrt(squares.reduce((sum, one) => sum + one, 0) / squares.length) : null;
}

/** Orbits, spectra and correlation functions of two windows, one over the other. */
class BeforeAfter extends HTMLElement {
  #channel = choiceOf("Channel of the spectrum", () => this.#spectrum());
  #spectra = /** @type {any} */ (html("line-chart", { role: "img" }));
  #pair = choiceOf("Pair of the correlation function", () => this.#correlation());
  #said = html("small", { class: "number" });
  #correlations = /** @type {any} */ (html("line-chart", { role: "img" }));
  /** The selected pair as text, for print. */
  #printed = [html("span", { class: "printed" }), html("span", { class: "printed" })];
  /** @type {Picture | null} */
  #before = null;
  /** @type {Picture | null} */
  #after = null;

  /** @param {Picture | null} before @param {Picture} after */
  show(before, after) {
    [this.#before, this.#after] = [before, after];
    const orbits = after.orbits.orbits.filter((one) => one.ellipse);
    const channels = after.spectra.densities.map((one) => one.channel);
    const pairs = after.correlations?.pairs ?? [];
    offered(this.#channel, channels);
    offered(this.#pair, pairs.map((one, at) => [String(at), pairName(one)]));
    const distances = pairs.map((one) => apart(this.#was(one), one) ?? -1);
    this.#pair.value = String(Math.max(0, distances.indexOf(Math.max(...distances)))); // the pair that has changed most
    const missing = [!orbits.length && after.orbits.reason, !channels.length && after.spectra.reason, after.correlations ? after.correlations.reason : "Correlation functions were not kept with this alarm, which is from an earlier version."];
    lay(
      this,
      html(
        "div",
        { class: "charts" },
        ...orbits.map((one) => {
          const was = before?.orbits.orbits.find((other) => other.location === one.location)?.ellipse ?? null;
          return orbitFigure({ ...one, nominal: was, estimated: null, path: null }, [], { measured: "after", nominal: "before" });
        }),
        channels.length > 0 && html("figure", {}, html("figcaption", {}, "Spectrum of ", this.#channel, this.#printed[0]), this.#spectra),
        pairs.length > 0 && html("figure", {}, html("figcaption", {}, "Correlation of ", this.#pair, this.#printed[1], " ", this.#said), this.#correlations),
      ),
      html("p", { class: "note" }, [...new Set(missing.filter(Boolean))].join("; ")),
    );
  }

  connectedCallback() {
    this.#spectrum();
    this.#correlation();
  }

  /** The same pair in the window before. @param {Pair} pair */
  #was(pair) {
    return this.#before?.correlations?.pairs.find((one) => one.first === pair.first && one.second === pair.second);
  }

  #spectrum() {
    const name = this.#channel.value;
    const now = this.#after?.spectra.densities.find((one) => one.channel === name);
    if (!this.#after || !now) return;
    const was = this.#before?.spectra.densities.find((one) => one.channel === name);
    const drawing = spectrumDrawing(this.#after.spectra, now);
    const same = was && this.#before?.spectra.frequencies_hz.length === drawing.x.length;
    /** @type {Line[]} */
    const lines = [{ ...AFTER, values: now.measured }];
    if (same) lines.unshift({ ...BEFORE, values: was.measured });
    this.#printed[0].textContent = name;
    this.#spectra.setAttribute("aria-label", `spectrum of ${name} before and after, ${printed(now.unit)}`);
    this.#spectra.draw({ ...drawing, lines, height: HEIGHT });
  }

  #correlation() {
    const found = this.#after?.correlations;
    const now = found?.pairs[Number(this.#pair.value)];
    if (!found || !now) return;
    const was = this.#was(now);
    const distance = apart(was, now);
    const lines = measuredLines(now, { ...AFTER, values: now.measured });
    if (was && distance !== null) lines.push({ ...BEFORE, values: was.measured });
    const said = distance === null ? "nothing from before to compare with" : `${figure(distance)} standard errors apart (rms)`;
    this.#said.textContent = said;
    this.#printed[1].textContent = pairName(now);
    this.#correlations.setAttribute("aria-label", `correlation function of ${pairName(now)} before and after, ${printed(now.unit)}: ${said}`);
    this.#correlations.draw({ x: found.lags_s.map((lag) => 1000 * lag), lines, band: [2, 1], marks: [], time: false, include: [0], unit: printed(now.unit), xUnit: "lag, ms", height: HEIGHT });
  }
}

customElements.define("before-after", BeforeAfter);
