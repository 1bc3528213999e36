import { confirmed } from "../elements/dialog.js";
import { html, lay, renew, table } from "../elements/markup.js";
import { clock } from "../monitor/figures.js";
import { LiveElement } from "../elements/live-element.js";
import { API, monitor } from "../monitor/monitor.js";

const DAYS = 90;
const TOKENS = `${API}/tokens`;
const SCOPES = /** @type {[string, string][]} */ ([["read", "look"], ["operate", "acknowledge, shelve and reset alarms, start replays"], ["configure", "take alarms out of service, administer"]]);

/** @import { TokenEntry } from "../monitor/records.d.ts" */

/** Tokens of the service, with a form to create one, and a button to revoke each. */
class TokenTable extends LiveElement {
  #open = html("p", { hidden: true }, "The API is open on this computer: anyone who can log in here may do everything, without a token. Tokens can already be created for later.");
  refreshS = 30;
  #made = html("div", { class: "made", hidden: true });
  #rows = html("div");
  #name = /** @type {HTMLInputElement} */ (html("input", { required: true, maxlength: 64, autocomplete: "off" }));
  #days = /** @type {HTMLInputElement} */ (html("input", { type: "number", min: 1, max: 3650, value: DAYS }));
  /** @type {HTMLInputElement[]} */
  #scopes = [];

  connectedCallback() {
    super.connectedCallback();
    this.#scopes = SCOPES.map(([scope]) => /** @type {HTMLInputElement} */ (html("input", { type: "checkbox", value: scope, checked: scope === "read" && monitor.may(scope), disabled: !monitor.may(scope) })));
    const boxes = SCOPES.map(([scope, text], at) => html("label", { class: "check" }, this.#scopes[at], html("span", {}, html("b", {}, scope), html("small", {}, ` ${text}${monitor.may(scope) ? "" : "; yours does not have it"}`))));
    this.replaceChildren(
      html("h2", {}, "Access tokens"),
      this.#open,
      this.message,
      this.#made,
      this.#rows,
      html(
        "form",
        { class: "new-token", submit: (event) => this.#create(event) },
        html("h2", {}, "New token"),
        html("label", {}, "Name, as shown in the audit log", this.#name),
        html("label", {}, "Valid for days (empty: until revoked)", this.#days),
        html("fieldset", {}, html("legend", {}, "Scopes (none includes another)"), ...boxes),
        html("button", { type: "submit", class: "main" }, "Create token"),
      ),
    );
  }

  async ask() {
    const found = await monitor.ask(TOKENS);
    this.#open.hidden = found.needed;
    const order = ["valid", "expired", "revoked"];
    const sorted = /** @type {TokenEntry[]} */ (found.tokens).sort((one, other) => order.indexOf(one.state) - order.indexOf(other.state) || other.created_ns - one.created_ns);
    const rows = sorted.map((one) => {
      const own = one.state === "valid" && one.name === monitor.caller?.name;
      return {
        key: one.token_id,
        cells: [
          html("div", {}, html("b", {}, one.name), own && " (yours)", html("small", {}, ` ${one.token_id}`)),
          html("span", {}, one.scopes.join(", ")),
          html("span", {}, one.state === "revoked" ? `revoked ${clock(one.revoked_ns)}` : one.state),
          html("time", { class: "number" }, clock(one.created_ns)),
          html("time", { class: "number" }, one.expires_ns === null ? "never" : clock(one.expires_ns)),
          html("time", { class: "number" }, one.last_used_ns === null ? "not since the monitor started" : clock(one.last_used_ns)),
          html("div", { class: "actions" }, one.state === "valid" && html("button", { type: "button", "aria-label": `Revoke the token of ${one.name}`, click: () => this.#revoke(one, own) }, "Revoke …")),
        ],
      };
    });
    renew(this.#rows, rows.length ? table(["token", "scopes", "state", "created", "expires", "last used", "actions"], rows, "") : html("p", { class: "note" }, "There are no tokens."));
  }

  /** @param {Event} event */
  async #create(event) {
    event.preventDefault();
    const scopes = this.#scopes.filter((one) => one.checked).map((one) => one.value);
    const days = this.#days.value ? Number(this.#days.value) : null;
    this.#made.hidden = true;
    await this.attempt(async () => {
      const { token, text } = await monitor.order(TOKENS, { name: this.#name.value.trim(), scopes, days });
      this.message.textContent = "";
      this.#name.value = "";
      this.#show(token, text);
      await this.load();
    }, "Not created. ");
  }

  /** Show the text of a new token until its creator confirms that it is stored safely. @param {TokenEntry} token @param {string} text */
  #show(token, text) {
    const shown = /** @type {HTMLInputElement} */ (html("input", { readonly: true, value: text, "aria-label": "New token", class: "number", spellcheck: "false" }));
    const hide = () => {
      this.#made.hidden = true;
      this.#made.replaceChildren();
    };
    const copy = html("button", { type: "button", click: () => navigator.clipboard?.writeText(text).then(() => { copy.textContent = "Copied"; }, () => shown.select()) }, "Copy");
    this.#made.hidden = false;
    lay(
      this.#made,
      html("p", { role: "status" }, html("b", {}, `The token of ${token.name}. It is shown this once: keep it where only its user can read it.`)),
      html("div", { class: "tools" }, shown, navigator.clipboard ? copy : null, html("button", { type: "button", click: hide }, "Hide")),
    );
    shown.focus();
    shown.select();
  }

  /** @param {TokenEntry} token @param {boolean} own */
  async #revoke(token, own) {
    const warning = own ? "It is the one you are signed in with: you will be signed out immediately." : "Its next request will be refused. This cannot be undone; a new token can be created.";
    if (!(await confirmed(`Revoke the token of ${token.name}?`, "Revoke", html("p", {}, warning)))) return;
    await this.attempt(async () => {
      await monitor.ask(`${TOKENS}/${token.token_id}`, { method: "DELETE" });
      this.message.textContent = `The token of ${token.name} is revoked.`;
      await this.load();
    }, "Not revoked. ");
  }
}

customElements.define("token-list", TokenTable);
