import { percent, stretch } from "../monitor/figures.js";
import { html, lay } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { parameterReadings } from "../machine/parameter-readings.js";
import { plainPicture } from "./plain-picture.js";
import { rotorPicture } from "./rotor-picture.js";

/** Drawing of the machine from its file, with the readings of each part beside it; only abnormal parts are coloured. */
class RotorDrawing extends MachineElement {
  needsFile = true;
  #why = "";

  /** @param {string} why */
  refused(why) {
    this.#why = why;
    this.show();
  }

  show() {
    const { file, health } = this;
    if (!file || !health) return lay(this, html("p", { class: "note" }, this.#why));
    const readings = parameterReadings(health);
    const report = health.report;
    const read = readings.some((one) => one.parameter.relative_change !== null);
    const known = file.rotor !== null || read;
    const abnormal = readings.filter((one) => one.severity).map((one) => `${one.stated.text} ${percent(one.parameter.relative_change)}, ${one.severity}`);
    const said = `${file.description || this.place}${known ? " as a rotor" : ""}; ${abnormal.join("; ") || "no part of it in alarm"}`;
    const elsewhere = known ? file.sensors.filter((one) => !["bearing", "disc", "shaft"].includes(one.location)) : [];
    lay(
      this,
      html(
        "figure",
        {},
        html("figcaption", {}, file.description || "The machine", html("small", {}, report ? ` ${stretch(report.start_ns, report.end_ns)}` : " nothing has been evaluated yet")),
        known ? rotorPicture(file, health, readings, said) : plainPicture(file.sensors, health, said),
        elsewhere.length ? plainPicture(elsewhere, health, "measuring points elsewhere") : null,
        html("p", { class: "note" }, read ? "Not to scale. Change ± 95 % interval; in brackets the smallest loss and gain that would be detected now." : known ? "Not to scale." : "Measuring points and levels; nothing is known of the machine between them."),
      ),
    );
  }
}

customElements.define("rotor-drawing", RotorDrawing);
