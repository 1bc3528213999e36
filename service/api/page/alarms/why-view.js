import { clock, figure, interval, lasting, quantity, within, Z95 } from "../monitor/figures.js";
import { html, lay, table } from "../elements/markup.js";
import { monitor, pathOf } from "../monitor/monitor.js";
import { levelUnit, limitText, measureText } from "../monitor/states.js";
import { curve } from "./likelihood-curve.js";
import "./alarm-list.js";
import "./before-after.js";
import "../elements/line-chart.js";
import "../elements/state-mark.js";

/** @import { AlarmEvidence, ChannelLevels, Parameter, Report } from "../monitor/records.d.ts" */

/** Measures that are shown even without a limit. */
const MEASURES = ["overall", "velocity", "x1", "x2", "crest", "kurtosis"];

/** Reading of a parameter in a report: since a change within its window, or over the whole window. @param {Report} report @param {string} name @returns {Parameter | undefined} */
function reading(report, name) {
  const since = report.verdict?.settled ? undefined : report.verdict?.current.find((one) => one.name === name);
  const found = since ?? report.parameters.find((one) => one.name === name);
  return found && found.relative_change !== null && found.standard_error !== null ? found : undefined;
}

/** Format a probability without false precision. @param {number} value */
const probability = (value) => (value > 0.999 ? "> 99.9 %" : value < 0.001 ? "< 0.1 %" : `${(100 * value).toFixed(1)} %`);

/** The evidence of one alarm: `place` is site/machine/alarm, and the occurrence if not the latest. */
class WhyView extends HTMLElement {
  connectedCallback() {
    const [site, machine, name, occurrence] = (this.getAttribute("place") ?? "").split("/");
    document.title = `Why? ${name} · ${site}/${machine} · rotorwatch`;
    lay(this, html("p", { class: "note" }, "Looking up what was kept …"));
    this.#load(`${site}/${machine}`, name, occurrence);
  }

  /** @param {string} place @param {string} name @param {string | undefined} occurrence */
  async #load(place, name, occurrence) {
    const path = `${pathOf(place)}/alarms/${encodeURIComponent(name)}`;
    try {
      const found = /** @type {AlarmEvidence} */ (await monitor.ask(`${path}/evidence${occurrence ? `?occurrence=${occurrence}` : ""}`));
      const events = await monitor.ask(`${pathOf(place)}/alarms/events?name=${encodeURIComponent(name)}&limit=100`);
      const raised = events.events.map((/** @type {{data: any}} */ one) => one.data).find((/** @type {any} */ one) => one.kind === "raised" && one.occurrence === found.occurrence);
      this.#lay(place, found, raised);
    } catch (error) {
      lay(this, html("h1", {}, `Why? ${name}`), html("p", { role: "status" }, error instanceof Error ? error.message : String(error)), html("a", { href: `#/machines/${place}` }, place));
    }
  }

  /** @param {string} place @param {AlarmEvidence} found @param {import("../monitor/records.d.ts").AlarmEventData | undefined} event */
  #lay(place, found, event) {
    const { name, before, raised } = found;
    const after = found.settled ?? raised;
    const stated = after.report.parameters.find((one) => one.name === name);
    const finding = raised.report.verdict?.changed.find((one) => one.name === name);
    const read = reading(after.report, name);
    const was = before ? reading(before.report, name) : undefined;
    lay(
      this,
      html("p", { class: "note" }, html("a", { href: `#/machines/${place}` }, place), " · ", html("a", { href: "#/alarms" }, "alarms"), ` · ${name}, occurrence ${found.occurrence}`),
      html("div", { class: "tools" }, html("h1", {}, stated?.text ?? monitor.machines.get(place)?.health.alarms.find((one) => one.name === name)?.text ?? name), event && html("state-mark", { state: event.severity }), html("button", { type: "button", class: "print", click: () => print() }, "Print")),
      html("p", { class: "verdict" }, this.#sentence(found, read, finding, event)),
      html("alarm-list", { place, alarm: name }),
      html("h2", {}, "Before and after"),
      html("p", { class: "note" }, before ? `Before: window to ${clock(before.report.end_ns)}. ` : "No picture from before was kept: there was no whole window without an alarm. ", found.settled ? `After: first window without older data, to ${clock(found.settled.report.end_ns)}.` : `After: the window that raised it, to ${clock(raised.report.end_ns)}; part of its data is from before.`),
      name.startsWith("level:") && this.#levels(name.slice("level:".length), before?.report, after.report),
      read && stated && curve(stated.text, was, read),
      this.#pictures(before, after),
      ...this.#weighed(raised.report),
      html("h2", {}, "Ruled out"),
      html("ul", {}, ...this.#ruledOut(name, before?.report, after.report).map((text) => html("li", {}, text))),
      html("h2", {}, "The data behind it"),
      this.#data(place, found, event),
    );
  }

  /** @param {AlarmEvidence} found @param {Parameter | undefined} read @param {import("../monitor/records.d.ts").Finding | undefined} finding @param {import("../monitor/records.d.ts").AlarmEventData | undefined} event */
  #sentence(found, read, finding, event) {
    const confidence = event?.evidence?.confidence ?? null;
    if (!read || !finding) return `${[event?.text ?? found.name, event && clock(event.time_ns), found.raised.report.reason].filter(Boolean).join("; ")}.`;
    const change = within(Number(read.relative_change), Z95 * Number(read.standard_error));
    const range = finding.between_ns ? ` (between ${clock(finding.between_ns[0])} and ${clock(finding.between_ns[1])})` : "";
    const sure = confidence === null ? "" : ` Probability that exactly this has changed: ${probability(confidence)}.`;
    return `${read.text} changed by ${change} since ${clock(finding.since_ns)}${range}, found in ${lasting(finding.stretch_s)} of data.${sure}`;
  }

  /** @param {import("../monitor/records.d.ts").Picture | null} before @param {import("../monitor/records.d.ts").Picture} after */
  #pictures(before, after) {
    const made = /** @type {any} */ (html("before-after"));
    made.show(before, after);
    return made;
  }

  /** Alternative sets of changed parameters, and how much less they explain the data. @param {Report} report */
  #weighed(report) {
    const weighed = report.verdict?.alternatives ?? [];
    if (!weighed.length) return [];
    const text = new Map(report.parameters.map((one) => [one.name, one.text]));
    const rows = weighed.map(({ names, probability: share, explained }) => ({
      cells: [
        html("b", {}, names.map((one) => text.get(one) ?? one).join(" and ") || "nothing changed"),
        html("span", { class: "number" }, probability(share)),
        html("span", { class: "number" }, `${(100 * explained).toFixed(explained > 0.99 ? 2 : 0)} % `, html("meter", { value: explained.toFixed(4), min: 0, max: 1, "aria-hidden": "true" })),
      ],
    }));
    return [
      table(["what changed", "probability", "share of the data explained"], rows, "What else was considered"),
      html("p", { class: "note" }, "Share explained: relative to what all parameters together would explain of the data that decided. Larger sets are penalised for their size."),
    ];
  }

  /** @param {string} name @param {Report | undefined} before @param {Report} after @returns {string[]} */
  #ruledOut(name, before, after) {
    const { verdict, misfit_z: misfit } = after;
    const rpm = (/** @type {Report | undefined} */ report) => (report?.speed_rad_s ? `${((report.speed_rad_s * 30) / Math.PI).toFixed(0)} rpm` : "unknown");
    const model = verdict?.outside_model
      ? `Not ruled out: the window is outside the model${after.suspect ? `, best explained by ${after.suspect}` : ""}.${verdict.changed.length ? " What is named has low confidence." : ""}`
      : misfit !== null && `Another kind of fault: the model explains the window (misfit ${figure(misfit)} standard deviations).`;
    const found = new Set(verdict?.changed.map((one) => one.name));
    const [also, others] = [true, false].map((changed) =>
      after.parameters.flatMap((one) => {
        const read = one.name === name || found.has(one.name) !== changed ? undefined : reading(after, one.name);
        return read?.interval_95 ? [`${read.text} ${interval(read.interval_95)}`] : [];
      }),
    );
    const apart = after.opinions.flatMap((opinion) => opinion.agreement.filter((one) => one.name === name && one.verdict === "disagree").map(() => opinion.by));
    const heard = after.opinions.filter((opinion) => opinion.parameters.some((one) => one.name === name && one.relative_change !== null)).map((one) => one.by);
    return [
      model || "",
      after.sensors.length ? `Not ruled out, a sensor fault: ${after.sensors.map((one) => one.text).join("; ")}.` : "A sensor fault: the checks of gain, noise and phase, and against the other sensors, found none.",
      `Another speed: ${rpm(before)} before, ${rpm(after)} after.`,
      also.length ? `Not ruled out, other changed parameters, 95 % intervals: ${also.join("; ")}.` : "",
      others.length ? `Other parameters, 95 % intervals: ${others.join("; ")}.` : "",
      apart.length ? `Disagrees: ${apart.join(", ")}.` : heard.length ? `Agrees: ${heard.join(", ")}.` : "",
      after.level_growth ? `Levels: ${after.level_growth.text}.` : "",
    ].filter(Boolean);
  }

  /** One channel's levels. @param {string} channel @param {Report | undefined} before @param {Report} after */
  #levels(channel, before, after) {
    const now = after.levels.find((one) => one.channel === channel);
    const was = before?.levels.find((one) => one.channel === channel);
    if (!now) return null;
    const measures = /** @type {Set<keyof ChannelLevels>} */ (new Set([...MEASURES, ...now.limits.map((one) => one.measure)]));
    const rows = [...measures].filter((measure) => now[measure] !== null).map((measure) => {
      const [old, value] = [was?.[measure], now[measure]].map((one) => (typeof one === "number" ? one : null));
      const limits = now.limits.find((one) => one.measure === measure);
      return {
        attributes: { class: limits?.state },
        cells: [
          html("b", {}, measureText(measure)),
          html("span", { class: "number" }, quantity(old, levelUnit(now, measure))),
          html("span", { class: "number" }, quantity(value, levelUnit(now, measure))),
          html("span", { class: "number" }, old && value ? `× ${figure(value / old)}` : ""),
          html("span", {}, limitText(limits, now)),
        ],
      };
    });
    return table(["level", "before", "after", "ratio", "limits"], rows, `Levels of ${channel}`);
  }

  /** @param {string} place @param {AlarmEvidence} found @param {import("../monitor/records.d.ts").AlarmEventData | undefined} event */
  #data(place, found, event) {
    const { start_ns: start, end_ns: end } = event?.evidence ?? found.raised.report;
    return html(
      "dl",
      {},
      html("dt", {}, "Raised"),
      html("dd", {}, event ? `${clock(event.time_ns)}: ${event.text}` : "no longer among the latest hundred events of this alarm"),
      html("dt", {}, "Data that decided"),
      html("dd", {}, `${clock(start)} to ${clock(end)}`),
      html("dt", {}, "Recordings"),
      html("dd", {}, html("a", { href: "#/recordings" }, "of this plant"), ", if any are made: those of this time can be replayed with another machine file or limit"),
      html("dt", {}, "From the API"),
      html("dd", {}, html("a", { href: `${pathOf(place)}/alarms/${encodeURIComponent(found.name)}/evidence?occurrence=${found.occurrence}` }, "evidence"), ", ", html("a", { href: `${pathOf(place)}/reports?since_ns=${start}&until_ns=${end + 1}` }, "reports of that time")),
    );
  }
}

customElements.define("why-view", WhyView);
