import { svg } from "./markup.js";
import { monitor, pathOf } from "../monitor/monitor.js";
import { MachineElement } from "./machine-element.js";

const [WIDTH, HEIGHT, POINTS, DAY_NS] = [120, 28, 48, 86_400e9];
const REFRESH_S = 300;
const AT_ONCE = 4;

/** Elements that wait for their turn: a plant of five hundred tiles asks a few at a time. @type {SparkLine[]} */
const waiting = [];
let asking = 0;

function next() {
  while (asking < AT_ONCE && waiting.length) {
    asking += 1;
    const one = /** @type {SparkLine} */ (waiting.shift());
    one.load().finally(() => {
      asking -= 1;
      next();
    });
  }
}

const seen = new IntersectionObserver((entries) => {
  for (const entry of entries) if (entry.isIntersecting) /** @type {SparkLine} */ (entry.target).queue();
});

/** The last 24 h of one reading, without numbers: `<spark-line place quantity series>`. */
class SparkLine extends MachineElement {
  #asked = -Infinity;

  connectedCallback() {
    super.connectedCallback();
    seen.observe(this);
    this.repeat(REFRESH_S, () => this.queue());
  }

  disconnectedCallback() {
    super.disconnectedCallback();
    seen.unobserve(this);
  }

  /** Load when it is one's turn. */
  queue() {
    if (performance.now() - this.#asked < 1000 * REFRESH_S - 1 || waiting.includes(this)) return;
    waiting.push(this);
    next();
  }

  async ask() {
    const end = this.health?.report?.end_ns;
    if (!this.isConnected || !end) return;
    this.#asked = performance.now();
    const of = { quantity: this.getAttribute("quantity") ?? "", name: this.getAttribute("series") ?? "", points: String(POINTS) };
    const read = (/** @type {Record<string, string>} */ more) => monitor.ask(`${pathOf(this.place)}/readings?${new URLSearchParams({ ...of, ...more })}`);
    const day = await read({ since_ns: String(Math.max(0, end - DAY_NS)) });
    // Buckets divide the time that was asked for: of a monitor that is younger than a day all may be in the last.
    this.#draw(day.buckets.length > POINTS / 4 ? day.buckets : (await read({})).buckets.filter((/** @type {{start_ns: number}} */ one) => one.start_ns >= end - DAY_NS));
  }

  refused() {
    this.replaceChildren();
  }

  /** @param {import("../monitor/records.js").Bucket[]} buckets */
  #draw(buckets) {
    if (buckets.length < 2) return this.replaceChildren();
    const [first, last] = [buckets[0].start_ns, buckets[buckets.length - 1].start_ns];
    const values = buckets.map((one) => one.mean);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    const x = (/** @type {number} */ ns) => 2 + ((WIDTH - 4) * (ns - first)) / (last - first);
    const y = (/** @type {number} */ value) => HEIGHT - 3 - ((HEIGHT - 6) * (value - low)) / (high - low || 1);
    const line = buckets.map((one) => `${x(one.start_ns).toFixed(1)},${y(one.mean).toFixed(1)}`).join(" ");
    this.replaceChildren(
      svg(
        "svg",
        { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, preserveAspectRatio: "none", "aria-hidden": "true" },
        svg("polyline", { points: line }),
      ),
    );
  }
}

customElements.define("spark-line", SparkLine);
