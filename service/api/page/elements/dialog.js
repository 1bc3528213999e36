import { html } from "./markup.js";

/**
 * Ask the user in a dialog.
 * @param {string} title
 * @param {string} action label of the button that confirms
 * @param {...import("./markup.js").Child} content
 * @returns {Promise<boolean>} whether the user confirms
 */
export function confirmed(title, action, ...content) {
  const cancel = html("button", { type: "button", click: () => dialog.close() }, "Cancel");
  const actions = html("div", { class: "actions" }, html("button", { value: "do", class: "main" }, action), cancel);
  const form = html("form", { method: "dialog" }, html("h2", { id: "asked" }, title), ...content, actions);
  const dialog = /** @type {HTMLDialogElement} */ (html("dialog", { "aria-labelledby": "asked" }, form));
  document.body.append(dialog);
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      dialog.remove();
      resolve(dialog.returnValue === "do");
    });
  });
}
