import { quantity, shownIn, stretch } from "../monitor/figures.js";
import { html, svg } from "../elements/markup.js";
import { plane, REACH, roundUp } from "./plane.js";
import { SamplePlot } from "./sample-plot.js";

/** @import { CentrelineSeries as Centrelines } from "../monitor/records.d.ts" */

/** Average shaft centreline at each location with two displacements. @extends {SamplePlot<Centrelines>} */
class CentrelinePlot extends SamplePlot {
  route = "centrelines";
  live = "windows of the history";
  refreshS = 60; // hundreds of reports are read

  /** @param {Centrelines} found */
  draw(found) {
    this.body.replaceChildren(html("div", { class: "charts" }, ...found.places.map((one) => this.#place(one))));
    const [first, last] = [found.times_ns[0], found.times_ns[found.times_ns.length - 1]];
    return found.places.length ? `${found.source}, ${found.times_ns.length} mean positions, ${stretch(first, last)}; from where the shaft was first` : "";
  }

  /** @param {Centrelines["places"][number]} one */
  #place(one) {
    const known = one.y_um.flatMap((y, at) => (y === null || one.z_um[at] === null ? [] : [[y, one.z_um[at]]]));
    const points = known.map(([y, z]) => [y - known[0][0], z - known[0][1]]);
    const [factor] = shownIn("µm");
    const reach = roundUp(factor * Math.max(...points.flat().map(Math.abs), 1e-3)) / factor;
    const drawn = points.map(([y, z]) => [(REACH * y) / reach, (-REACH * z) / reach]);
    const [first, last] = [drawn[0], drawn[drawn.length - 1]];
    const moved = points[points.length - 1] ?? [0, 0];
    const said = `moved by ${quantity(moved[0], "µm")} along y and ${quantity(moved[1], "µm")} along z`;
    return html(
      "figure",
      {},
      html("figcaption", {}, one.location, html("small", { class: "number" }, ` ${said}`)),
      plane(
        `centreline at the ${one.location}: ${said}`,
        quantity(reach / 2, "µm"),
        svg("polyline", { class: "path", points: drawn.map((each) => each.map((part) => part.toFixed(1)).join(",")).join(" ") }),
        first && svg("circle", { class: "first", cx: first[0], cy: first[1], r: 3.5 }),
        last && svg("circle", { class: "pulse", cx: last[0], cy: last[1], r: 3.5 }),
      ),
      html("p", { class: "keys" }, html("span", { class: "key path" }, "mean positions"), html("span", { class: "key first" }, "first"), html("span", { class: "key pulse" }, "last")),
    );
  }
}

customElements.define("centreline-plot", CentrelinePlot);
