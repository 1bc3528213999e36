import { svg } from "./markup.js";
import { GAP, shortest } from "../monitor/figures.js";
import { monitor } from "../monitor/monitor.js";
import { MachineElement } from "./machine-element.js";

const [WIDTH, HEIGHT] = [120, 28];
const REFRESH_S = 300;
const [TOGETHER, SOON_MS, PACE_MS] = [64, 50, 1000];

/** Visible elements that wait for their line; their data are requested together, once a second. @type {Set<SparkLine>} */
const waiting = new Set();
let asking = false;

async function askTogether() {
  if (asking) return;
  asking = true;
  await pause(SOON_MS);
  while (waiting.size) {
    const some = [...waiting].slice(0, TOGETHER);
    for (const one of some) waiting.delete(one);
    if (document.hidden) continue;
    for (const one of some) one.asked(true);
    try {
      const { trends } = await monitor.ask(`/api/v1/trends?${new URLSearchParams(some.map((one) => ["of", one.of]))}`);
      some.forEach((one, at) => one.draw(trends[at]));
    } catch {
      for (const one of some) one.replaceChildren();
    }
    for (const one of some) one.asked(false);
    await pause(PACE_MS);
  }
  asking = false;
}

const pause = (/** @type {number} */ ms) => new Promise((resolve) => setTimeout(resolve, ms));

const seen = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) /** @type {SparkLine} */ (target).seen(isIntersecting);
});

/**
 * The last 24 h of one reading, without numbers: `<spark-line place quantity series range>`. The vertical axis always
 * includes `range`, two numbers, so that scatter far from a limit looks small.
 */
class SparkLine extends MachineElement {
  #drawn = -Infinity;
  #visible = false;
  #asked = false;

  connectedCallback() {
    super.connectedCallback();
    seen.observe(this);
    this.repeat(REFRESH_S / 5, () => this.seen(this.#visible));
  }

  disconnectedCallback() {
    super.disconnectedCallback();
    seen.unobserve(this);
    waiting.delete(this);
  }

  /** Name of the reading shown: site/machine/quantity/series. */
  get of() {
    return [this.place, this.getAttribute("quantity"), this.getAttribute("series")].join("/");
  }

  /** Wait for a line while the element is visible. @param {boolean} visible */
  seen(visible) {
    this.#visible = visible;
    waiting.delete(this);
    if (!visible || this.#asked || performance.now() - this.#drawn < 1000 * REFRESH_S) return;
    waiting.add(this);
    askTogether();
  }

  /** Note whether a request is under way, so that a tile that moves meanwhile makes no second one. @param {boolean} now */
  asked(now) {
    this.#asked = now;
  }

  /** @param {import("../monitor/records.d.ts").Trend} trend */
  draw({ starts_ns: starts, means }) {
    if (starts.length < 2) return this.replaceChildren();
    this.#drawn = performance.now();
    const within = (this.getAttribute("range") ?? "").split(" ").filter(Boolean).map(Number);
    const [first, last] = [starts[0], starts[starts.length - 1]];
    const [low, high] = [Math.min(...means, ...within), Math.max(...means, ...within)];
    const x = (/** @type {number} */ ns) => 2 + ((WIDTH - 4) * (ns - first)) / (last - first);
    const y = (/** @type {number} */ value) => HEIGHT - 3 - ((HEIGHT - 6) * (value - low)) / (high - low || 1);
    const longest = GAP * shortest(starts);
    /** @type {string[][]} */
    const parts = [];
    starts.forEach((start, at) => {
      if (!at || start - starts[at - 1] > longest) parts.push([]);
      parts[parts.length - 1].push(`${x(start).toFixed(1)},${y(means[at]).toFixed(1)}`);
    });
    const lines = parts.map((points) => svg("polyline", { points: (points[1] ? points : [points[0], points[0]]).join(" ") })); // a single point is drawn as a dot
    this.replaceChildren(svg("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", "aria-hidden": "true" }, ...lines));
  }
}

customElements.define("spark-line", SparkLine);
