/** @import { Parameter } from "../monitor/records.d.ts" */
/** @typedef {{stated: Parameter, parameter: Parameter, read: boolean, why: string, seen: import("../monitor/records.d.ts").Detectable | undefined, severity: string}} Reading */

/**
 * Current reading of each parameter; while the window straddles a change, that since the change.
 * @param {import("../monitor/records.d.ts").Health | undefined} health
 * @returns {Reading[]}
 */
export function parameterReadings(health) {
  const report = health?.report;
  const verdict = report?.verdict;
  if (!health || !report || !verdict) return [];
  const current = new Map((verdict.settled ? report.parameters : verdict.current).map((one) => [one.name, one]));
  return report.parameters.map((stated) => {
    const parameter = current.get(stated.name) ?? stated;
    const known = parameter.relative_change !== null && parameter.interval_95 !== null;
    const late = known && !current.has(stated.name);
    return {
      stated,
      parameter,
      read: known && !late,
      why: late ? "too little data since the change" : known ? "" : `not evaluable: ${parameter.reason}`,
      seen: report.detectable.find((one) => one.name === stated.name),
      severity: health.alarms.find((one) => one.name === stated.name && one.raised)?.severity ?? "",
    };
  });
}
