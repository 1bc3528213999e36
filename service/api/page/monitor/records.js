/**
 * The records of the API as far as the page reads them; `/openapi.json` describes them all.
 *
 * @typedef {{name: string, text: string, state: string, pending: boolean, clearing: boolean, present: boolean, raised: boolean, severity: string, since_ns: number, raised_ns: number | null, occurrence: number, relative_change: number | null, standard_error: number | null, interval_95: [number, number] | null, low_confidence: boolean, note: string, shelf: {until_ns: number, one_shot: boolean, by: string, reason: string} | null, suppressed_by: string, out_of_service_by: string, out_of_service_reason: string, version: number, evidence: Evidence | null}} Alarm
 * @typedef {{start_ns: number, end_ns: number, confidence: number | null}} Evidence
 * @typedef {{site: string, machine: string, name: string, text: string, kind: string, state: string, severity: string, time_ns: number, sequence: number, actor: string, reason: string, note: string, occurrence: number, evidence: Evidence | null}} AlarmEvent
 * @typedef {{name: string, text: string, by: string, relative_change: number | null, standard_error: number | null, interval_95: [number, number] | null, reason: string, vector: {text: string, magnitude_change: number, turned_deg: number | null, turned_interval_95_deg: [number, number] | null} | null}} Parameter
 * @typedef {{by: string, reason: string, parameters: Parameter[], agreement: {name: string, verdict: string}[]}} Opinion
 * @typedef {{name: string, loss: number, gain: number, length_s: number}} Detectable
 * @typedef {{text: string, detected: boolean, confidence: number, settled: boolean, low_confidence: boolean, outside_model: boolean, current: Parameter[], changed: Finding[], alternatives?: Alternative[]}} Verdict
 * @typedef {{name: string, text: string, since_ns: number, stretch_s: number, between_ns?: [number, number] | null}} Finding
 * @typedef {{names: string[], probability: number, explained: number}} Alternative
 * @typedef {{measure: string, alert: number | null, danger: number | null, fall: number | null, source: string, state: string, text: string}} LevelLimits
 * @typedef {{channel: string, unit: string, detection: string, overall: number | null, velocity: number | null, x1: number | null, x2: number | null, mean: number | null, crest: number | null, kurtosis: number | null, zone: string, limits: LevelLimits[]}} ChannelLevels
 * @typedef {{start_ns: number, end_ns: number, state: string, filled: number, speed_rad_s: number | null, misfit_z: number | null, suspect: string, verdict: Verdict | null, parameters: Parameter[], opinions: Opinion[], detectable: Detectable[], sensors: {text: string, states: string[]}[], shapes: {text: string}[], levels: ChannelLevels[], level_growth: {text: string} | null, reason: string}} Report
 * @typedef {{accepted_blocks: number, refused_blocks: Record<string, number>, gaps: number, missing_s: number, queue_dropped_blocks: number, link_missed_blocks: number, last_refusal: string, last_gap: string}} Quality
 * @typedef {{publisher_alive: boolean, silent: boolean, silent_since_ns: number | null, data_age_s: number | null, replay_announced: boolean, descriptor_mismatch: string[]}} Stream
 * @typedef {{site: string, machine: string, state: string, reason: string, filled: number, report: Report | null, alarms: Alarm[], quality: Quality, stream: Stream, restart: string, worker_errors: number, last_worker_error: string, machine_hash: string}} Health
 * @typedef {{name: string, start_ns: number, length_ns: number, count: number, minimum: number, mean: number, maximum: number, mean_standard_error: number | null}} Bucket
 * @typedef {{starts_ns: number[], means: number[]}} Trend
 * @typedef {{semi_major: number, semi_minor: number, tilt_deg: number, sense: string, precession: string | null}} Ellipse
 * @typedef {{location: string, unit: string, ellipse: Ellipse | null, nominal: Ellipse | null, estimated: Ellipse | null, path: {times_s: number[], y: number[], z: number[]} | null}} PlaceOrbit
 * @typedef {{speed_rad_s: number | null, orbits: PlaceOrbit[], revolutions: number, pulses_s: number[], reason: string, path_reason: string}} Orbits
 * @typedef {{channel: string, quantity: string, unit: string, measured: (number | null)[], nominal: (number | null)[] | null, estimated: (number | null)[] | null, rms: number | null}} Density
 * @typedef {{frequencies_hz: number[], rotation_hz: number | null, left_out_hz: [number, number] | null, densities: Density[], theory: {nominal_reason: string, estimated_reason: string}, reason: string, interval_95: [number, number] | null}} Spectra
 * @typedef {{report: Report, spectra: Spectra, orbits: Orbits}} Picture
 * @typedef {{site: string, machine: string, name: string, occurrence: number, before: Picture | null, raised: Picture, settled: Picture | null}} AlarmEvidence
 * @typedef {{token_id: string, name: string, scopes: string[], state: string, created_ns: number, expires_ns: number | null, revoked_ns: number | null, last_used_ns: number | null}} TokenEntry
 * @typedef {{number: number, at_ns: number, actor: string, address: string, method: string, path: string, status: number, action: string, machine: string, alarm: string, reason: string}} AuditRecord
 * @typedef {{name: string, target: string, machines: string[], kinds: string[], severities: string[], annunciated_only: boolean, state: string, pending: number, delivered: number, failed_attempts: number, last_delivered_ns: number | null, last_error: string, last_error_ns: number | null}} WebhookStatus
 * @typedef {{database: string, size_bytes: number, reports_days: number, readings_days: number, buckets_days: number, machines: {site: string, machine: string, oldest_event_ns: number | null, oldest_report_ns: number | null, oldest_reading_ns: number | null}[]}} HistoryStatus
 * @typedef {{ready: boolean, reasons: string[], failing_webhooks: string[], machines: {site: string, machine: string, state: string, worker_alive: boolean, worker_errors: number, last_worker_error: string, worker_busy_s: number, queue_blocks: number, history_waiting: number, recording: string, trouble: string}[]}} Readiness
 * @typedef {{id: string, site: string, machine: string, start_ns: number, end_ns: number, messages: number | null, size_bytes: number, complete: boolean, kept_because: string, problem: string, data_start_ns: number | null, data_end_ns: number | null}} RecordingEntry
 * @typedef {{id: string, state: string, mode: string, recordings: string[], machine: string | null, changes: string[], from_ns: number | null, to_ns: number | null, pace: number | null, prefix: string, started_ns: number, progress: {fraction: number, position_ns: number, messages: number} | null, summary: OfflineSummary | null, error: string}} ReplayJob
 * @typedef {{site: string, machine: string, bundle: string | null, machine_hash: string, windows: number, alarms: number, raised: string[], blocks: number, refused_blocks: Record<string, number>, gaps: number, missing_s: number, data_s: number, elapsed_s: number, times_real_time: number, descriptor_differences: string[], limits: Record<string, {raise_above: number, danger_above: number}>, stopped: boolean}} OfflineSummary
 */
export {};
