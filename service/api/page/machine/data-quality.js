import { clock, figure, lasting } from "../monitor/figures.js";
import { html } from "../elements/markup.js";
import { MachineElement } from "../elements/machine-element.js";
import { monitor } from "../monitor/monitor.js";

/** Data received from the machine, and their quality. */
class DataQuality extends MachineElement {
  connectedCallback() {
    super.connectedCallback();
    this.repeat(5, () => this.show());
  }

  show() {
    const health = this.health;
    if (!health) return;
    const { quality, stream, report } = health;
    const speed = report?.speed_rad_s ?? null;
    const age = monitor.dataAge(this.place);
    const refused = Object.entries(quality.refused_blocks);
    /** @type {[string, string | false][]} */
    const facts = [
      ["newest data", age === null ? "none since the monitor started" : `${lasting(age)} old`],
      ["silent", stream.silent && stream.silent_since_ns !== null && `since ${clock(stream.silent_since_ns)}`],
      ["window", `${(100 * health.filled).toFixed(0)} % full${report ? `, until ${clock(report.end_ns)}` : ""}`],
      ["speed", speed !== null && `${figure(Math.round((speed * 300) / Math.PI) / 10)} rpm`],
      ["misfit", typeof report?.misfit_z === "number" && `${figure(report.misfit_z)} standard deviations`],
      ["gyroscopic moments", report?.gyroscopic === "opposite" && "the opposite sense to Eq. (27): it explains this machine"],
      ["blocks", `${quality.accepted_blocks} accepted, ${refused.reduce((sum, [, count]) => sum + count, 0)} refused`],
      ["refused", refused.length > 0 && refused.map(([reason, count]) => `${reason} ${count}`).join(", ")],
      ["last refusal", quality.last_refusal],
      ["gaps", `${quality.gaps}${quality.missing_s ? `, ${figure(quality.missing_s)} s missing` : ""}`],
      ["last gap", quality.last_gap],
      ["dropped", quality.queue_dropped_blocks > 0 && `${quality.queue_dropped_blocks} blocks, the monitor could not keep up`],
      ["not evaluated", quality.skipped_windows > 0 && `${quality.skipped_windows} windows, the monitor could not keep up`],
      ["lost in transit", quality.link_missed_blocks > 0 && `${quality.link_missed_blocks} blocks`],
      ["publisher", stream.publisher_alive ? "announced" : "not announced"],
      ["replay", stream.replay_announced && "a replay is announced on the machine's own keys; it is not evaluated"],
      ["descriptor differs", stream.descriptor_mismatch.join(", ")],
      ["restart", health.restart],
      ["monitor errors", health.worker_errors > 0 && `${health.worker_errors}: ${health.last_worker_error}`],
    ];
    this.replaceChildren(html("h2", {}, "Data"), html("dl", {}, ...facts.filter(([, text]) => text).flatMap(([name, text]) => [html("dt", {}, name), html("dd", {}, text)])));
  }
}

customElements.define("data-quality", DataQuality);
