import { quantity, stretch } from "../monitor/figures.js";
import { choiceOf, offered, SamplePlot } from "./sample-plot.js";
import "../elements/line-chart.js";

/** @import { WaveformSnapshot as Waveforms } from "../monitor/records.d.ts" */

/** The newest revolutions at one location, channel by channel, with the pulses of the phase reference. @extends {SamplePlot<Waveforms>} */
class WaveformPlot extends SamplePlot {
  route = "waveforms";
  #where = choiceOf("Place", () => this.load());

  choices() {
    return [this.#where];
  }

  offer() {
    offered(this.#where, [...new Set(this.sensors.map((one) => one.location))]);
  }

  /** @returns {[string, string][]} */
  asked() {
    return this.sensors.filter((one) => one.location === this.#where.value).map((one) => ["channel", one.name]);
  }

  /** @param {Waveforms} found */
  draw(found) {
    this.lines(
      found.waveforms.map((one) => ({
        name: one.channel,
        more: `about a mean of ${quantity(one.mean, one.unit)}`,
        said: `waveform of ${one.channel}`,
        drawing: {
          x: found.times_s.map((time) => 1000 * time),
          lines: [{ label: one.channel, values: one.values, width: 1.2 }],
          marks: found.pulses_s.map((pulse) => ({ at: 1000 * pulse, axis: "x", colour: "pulse", dash: [3, 3] })),
          time: false,
          include: [0],
          unit: one.unit,
          xUnit: "time, ms",
          height: 190,
        },
      })),
    );
    const turns = found.revolutions ? `${found.revolutions} revolutions` : "the newest moment";
    const marks = found.pulses_s.length ? ", dashed where the keyphasor's mark passed" : "";
    return found.start_ns && found.end_ns ? `${found.source}, ${turns} of ${stretch(found.start_ns, found.end_ns)}${marks}` : "";
  }
}

customElements.define("waveform-plot", WaveformPlot);
