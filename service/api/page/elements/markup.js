/** Creates elements without parsing HTML: text stays text, so the name of a machine can never become markup. */

/** @typedef {Node | string | number | null | undefined | false} Child */
/** @typedef {Record<string, string | number | boolean | null | undefined | ((event: any) => void)>} Attributes */

const SVG = "http://www.w3.org/2000/svg";

/** Event listeners of each element, by event name. @type {WeakMap<Element, Record<string, (event: any) => void>>} */
const heard = new WeakMap();

/** @param {Element} made @param {string} name @param {(event: any) => void} hear */
function listen(made, name, hear) {
  const known = heard.get(made) ?? {};
  if (!(name in known)) made.addEventListener(name, (event) => heard.get(made)?.[name](event));
  heard.set(made, { ...known, [name]: hear });
}

/**
 * @param {Element} made
 * @param {Attributes} attributes
 * @param {Child[]} children
 */
function filled(made, attributes, children) {
  for (const [name, value] of Object.entries(attributes)) {
    if (typeof value === "function") listen(made, name, value);
    else if (value === true) made.setAttribute(name, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(name, String(value));
  }
  made.append(...nodes(children)); // an element that fills itself keeps its content
  return made;
}

/** Children as nodes and text without empty ones, numbers with a true minus sign. @param {Child[]} children */
function nodes(children) {
  const there = children.filter((child) => child !== null && child !== undefined && child !== false && child !== "");
  return there.map((child) => (child instanceof Node ? child : new Text(String(child).replace(/(^|[^\w-])-(?=\d)/g, "$1−"))));
}

/**
 * Replace all children; empty ones are left out.
 * @param {Element} parent
 * @param {...Child} children
 */
export function lay(parent, ...children) {
  parent.replaceChildren(...nodes(children));
}

/**
 * Replace children, but change only what differs: an existing element keeps the focus and its text selection, and stays open.
 * For content that is created anew each time; elements that may move, or must not be turned into others, have the attribute `data-key`.
 * @param {Element} parent
 * @param {...Child} children
 */
export function renew(parent, ...children) {
  const focused = document.activeElement;
  match(parent, nodes(children));
  if (focused instanceof HTMLElement && focused !== document.activeElement && parent.contains(focused)) focused.focus({ preventScroll: true });
}

/** @param {Node} one */
const keyOf = (one) => (one instanceof Element ? one.getAttribute("data-key") : null);

/** @param {Element} parent @param {Node[]} wanted */
function match(parent, wanted) {
  wanted.forEach((one, at) => {
    /** @type {Node | undefined} */
    const there = one.parentNode === parent ? one : [...parent.childNodes].slice(at).find((old) => old.nodeName === one.nodeName && keyOf(old) === keyOf(one));
    if (there && there !== one) liken(there, one);
    const child = there ?? one;
    if (parent.childNodes[at] !== child) parent.insertBefore(child, parent.childNodes[at] ?? null);
  });
  while (parent.childNodes.length > wanted.length) parent.lastChild?.remove();
}

/** Change a node to be like another one. @param {Node} old @param {Node} one */
function liken(old, one) {
  if (!(old instanceof Element) || !(one instanceof Element)) {
    if (old.nodeValue !== one.nodeValue) old.nodeValue = one.nodeValue;
    return;
  }
  for (const name of old.getAttributeNames()) if (!one.hasAttribute(name) && name !== "open") old.removeAttribute(name);
  for (const { name, value } of one.attributes) if (old.getAttribute(name) !== value && name !== "open") old.setAttribute(name, value);
  if (old instanceof HTMLInputElement && one instanceof HTMLInputElement) old.checked = one.checked;
  for (const [name, hear] of Object.entries(heard.get(one) ?? {})) listen(old, name, hear);
  if (!old.localName.includes("-")) match(old, [...one.childNodes]); // custom elements fill themselves
}

/**
 * Give a parent one child for each key, in this order; a child that stays is the same element, and keeps the focus.
 * @param {Element} parent
 * @param {string[]} keys
 * @param {Map<string, HTMLElement>} made children by key
 * @param {(key: string) => HTMLElement} make
 */
export function arrange(parent, keys, made, make) {
  const focused = document.activeElement;
  const children = keys.map((key) => {
    const child = made.get(key) ?? make(key);
    made.set(key, child);
    return child;
  });
  const kept = new Set(children);
  for (const old of /** @type {HTMLElement[]} */ ([...parent.children])) if (!kept.has(old)) old.remove();
  children.forEach((child, at) => parent.children[at] === child || parent.insertBefore(child, parent.children[at] ?? null));
  if (focused instanceof HTMLElement && focused !== document.activeElement && parent.contains(focused)) focused.focus({ preventScroll: true });
}

/**
 * Create an element of the page; attributes that are functions are listeners.
 * @param {string} tag
 * @param {Attributes} [attributes]
 * @param {...Child} children
 * @returns {HTMLElement}
 */
export function html(tag, attributes = {}, ...children) {
  return /** @type {HTMLElement} */ (filled(document.createElement(tag), attributes, children));
}

/**
 * Create an SVG element.
 * @param {string} tag
 * @param {Attributes} [attributes]
 * @param {...Child} children
 * @returns {SVGElement}
 */
export function svg(tag, attributes = {}, ...children) {
  return /** @type {SVGElement} */ (filled(document.createElementNS(SVG, tag), attributes, children));
}

/**
 * A table that a phone shows as cards: each cell has the name of its column. A row with a key stays the same element when the table is updated.
 * @param {string[]} heads
 * @param {{cells: Child[], attributes?: Attributes, key?: string | number}[]} rows
 * @param {string} caption
 */
export function table(heads, rows, caption) {
  const body = rows.map(({ cells, attributes, key }) =>
    html("tr", { ...attributes, "data-key": key }, ...cells.map((cell, at) => html(at ? "td" : "th", { "data-head": heads[at], scope: at ? null : "row" }, cell))),
  );
  return html(
    "table",
    {},
    html("caption", {}, caption),
    html("thead", {}, html("tr", {}, ...heads.map((head) => html("th", { scope: "col" }, head)))),
    html("tbody", {}, ...body),
  );
}
