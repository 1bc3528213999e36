import { html } from "./elements/markup.js";
import { monitor } from "./monitor/monitor.js";

/** Asks for an access token, which the browser then keeps until it is closed. */
class SignIn extends HTMLElement {
  #token = /** @type {HTMLInputElement} */ (html("input", { type: "password", name: "token", required: true, autocomplete: "current-password", placeholder: "rw_…", "aria-describedby": "sign-in-why" }));
  #why = html("p", { id: "sign-in-why", role: "status" });

  connectedCallback() {
    this.#why.textContent = monitor.stranger;
    this.replaceChildren(
      html("h1", {}, "Sign in"),
      html("form", { submit: (event) => this.#submit(event) }, html("label", {}, "Access token", this.#token), html("button", { type: "submit" }, "Sign in")),
      this.#why,
      html("p", { class: "note" }, "Whoever runs this service creates one with ", html("code", {}, "rotorwatch token create NAME --scope read --scope operate"), ". The browser keeps it until it is closed, or you sign out."),
    );
    this.#token.focus();
  }

  /** @param {Event} event */
  async #submit(event) {
    event.preventDefault();
    try {
      await monitor.signIn(this.#token.value.trim());
    } catch (error) {
      this.#why.textContent = error instanceof Error ? error.message : String(error);
      this.#token.select();
    }
  }
}

customElements.define("sign-in", SignIn);
