import { html } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";

/** Values with their paths in the file, for instance `window.length_s`; missing values are left out. @param {unknown} value @param {string} name @returns {[string, string][]} */
function facts(value, name) {
  if (value === null || value === "" || (Array.isArray(value) && !value.length)) return [];
  if (typeof value !== "object") return [[name, String(value)]];
  if (Array.isArray(value) && value.every((one) => typeof one !== "object")) return [[name, value.join(", ")]];
  return Object.entries(value).flatMap(([key, one]) => {
    const part = Array.isArray(value) ? /** @type {any} */ (one).name ?? key : key;
    return facts(one, name ? `${name}.${part}` : part);
  });
}

/** The machine file in use, line by line. */
class MachineFacts extends MachineElement {
  needsFile = true;
  message = html("p", { class: "note" });
  /** @type {unknown} */
  #shown = null;

  show() {
    if (!this.file || this.file === this.#shown) return;
    this.#shown = this.file;
    this.replaceChildren(
      html("p", { class: "note" }, `The machine file in use, with its defaults filled in; units are in the names. Identity ${this.health?.machine_hash}.`),
      html("dl", { class: "facts" }, ...facts(this.file, "").flatMap(([name, text]) => [html("dt", {}, name), html("dd", {}, text)])),
    );
  }
}

customElements.define("machine-facts", MachineFacts);
