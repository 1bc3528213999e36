import { html, svg } from "./markup.js";
import { STATES } from "../monitor/states.js";

/** Outlined shapes for normal states, filled shapes for abnormal ones. @type {Record<string, string>} */
const SHAPES = {
  danger: "M8 0 16 8 8 16 0 8Z",
  alert: "M8 1 16 15 0 15Z",
  "outside-model": "M1 1H15V15H1Z",
  "data-health": "M4 1H12L16 8 12 15H4L0 8Z",
  "not-evaluable": "M2 6H14V10H2Z",
  "no-data": "M2 4 4 2 8 6 12 2 14 4 10 8 14 12 12 14 8 10 4 14 2 12 6 8Z",
};
const CALM = "M8 2A6 6 0 1 1 7.99 2Z";

/** A state as shape, colour and word: `<state-mark state="alert">`. */
class StateMark extends HTMLElement {
  static observedAttributes = ["state"];

  attributeChangedCallback() {
    const state = this.getAttribute("state") ?? "";
    this.className = state in SHAPES ? `mark ${state}` : "mark calm";
    this.replaceChildren(
      svg("svg", { viewBox: "0 0 16 16", "aria-hidden": "true" }, svg("path", { d: SHAPES[state] ?? CALM })),
      html("span", {}, STATES[state] ?? state),
    );
  }
}

customElements.define("state-mark", StateMark);
