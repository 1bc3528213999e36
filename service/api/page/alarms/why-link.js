import { html } from "../elements/markup.js";
import { ofMachine } from "../monitor/states.js";

/** To what an alarm rests on; nothing for those that no window decides. @param {string} place @param {{name: string, occurrence: number, evidence: unknown}} alarm */
export const why = (place, { name, occurrence, evidence }) => evidence && ofMachine({ name }) ? html("a", { href: `#/why/${place}/${encodeURIComponent(name)}/${occurrence}` }, "Why?") : null;
