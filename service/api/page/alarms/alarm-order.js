import { confirmed } from "../elements/dialog.js";
import { html } from "../elements/markup.js";

const TITLES = /** @type {Record<string, string>} */ ({ shelve: "Shelve", "remove-from-service": "Take out of service" });
const HOURS = [1, 4, 8];

/**
 * Body of an order; asks the operator for a reason if the order requires one.
 * @param {string} kind
 * @param {string} about
 * @returns {Promise<Record<string, unknown> | null>} null if the operator cancels
 */
export async function ordered(kind, about) {
  if (!(kind in TITLES)) return {};
  const reason = /** @type {HTMLInputElement} */ (html("input", { required: true, maxlength: 500, pattern: ".*\\S.*", id: "reason", autocomplete: "off" }));
  const hours = /** @type {HTMLSelectElement} */ (html("select", { id: "hours" }, ...HOURS.map((each) => html("option", { value: each }, `${each} h`)), html("option", { value: "" }, "as long as the machine file allows")));
  const oneShot = /** @type {HTMLInputElement} */ (html("input", { type: "checkbox", id: "one-shot" }));
  const shelves = kind === "shelve";
  const done = await confirmed(
    TITLES[kind],
    TITLES[kind],
    html("p", {}, about),
    html("label", { for: "reason" }, "Reason"),
    reason,
    shelves && html("label", { for: "hours" }, "For"),
    shelves && hours,
    shelves && html("label", { class: "check" }, oneShot, "until it clears, if that is earlier"),
  );
  if (!done) return null;
  const time = shelves ? { one_shot: oneShot.checked, ...(hours.value ? { duration_s: 3600 * Number(hours.value) } : {}) } : {};
  return { reason: reason.value.trim(), ...time };
}
