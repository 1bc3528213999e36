import { html } from "../elements/markup.js";
import { ofMachine } from "../monitor/states.js";

/** Link to the evidence of an alarm; nothing for alarms that are not decided on a window. @param {string} place @param {{name: string, occurrence: number, evidence: unknown}} alarm */
export const why = (place, { name, occurrence, evidence }) => evidence && ofMachine({ name }) ? html("a", { href: `#/why/${place}/${encodeURIComponent(name)}/${occurrence}` }, "Why?") : null;
