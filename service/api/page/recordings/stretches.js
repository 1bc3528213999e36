/** @import { RecordingEntry, Report } from "../monitor/records.d.ts" */
/** @typedef {{state: string, from: number, to: number, at: number}} Run */

/** Ids of the recordings that can be replayed and have data within a stretch of time. @param {RecordingEntry[]} recordings @param {number} from @param {number} to @returns {Set<string>} */
export function within(recordings, from, to) {
  const there = recordings.filter((one) => one.complete && !one.problem && Number(one.data_start_ns) < to && Number(one.data_end_ns) > from);
  return new Set(there.map((one) => one.id));
}

/** Runs of equal states in order of time: each from the end of the window before, with the index of its first window. @param {Report[]} reports @returns {Run[]} */
export function runs(reports) {
  /** @type {Run[]} */
  const found = [];
  let from = reports[0]?.start_ns ?? 0;
  reports.forEach((one, at) => {
    const last = found[found.length - 1];
    if (last?.state === one.state) last.to = one.end_ns;
    else found.push({ state: one.state, from, to: one.end_ns, at });
    from = one.end_ns;
  });
  return found;
}
