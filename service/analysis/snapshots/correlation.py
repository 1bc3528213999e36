"""Correlation functions of the latest window, with theory."""

from collections.abc import Sequence

import numpy as np

from models.signals.block import FloatArray
from models.signals.channels import Channel, state_name
from rotorwatch.records.snapshots import CorrelationPair, CorrelationSnapshot, Units
from service.analysis.correlation import MeasuredCorrelations, measured_correlations
from service.analysis.prediction import Prediction
from service.analysis.snapshots.channels import check_held, chosen_pairs, figures, product_unit, seen_by
from service.analysis.snapshots.heading import LatestData, Subject, heading, no_window, theory, unsent


def correlation_snapshot(
    subject: Subject,
    data: LatestData,
    prediction: Prediction,
    first: Sequence[str] = (),
    second: Sequence[str] = (),
    units: Units = "channel",
) -> CorrelationSnapshot:
    """Correlation functions of pairs of channels, with standard errors and predictions.

    Parameters
    ----------
    first, second : sequence of str
        Names of the references, and of as many responses; for defaults see
        `service.analysis.snapshots.channels.chosen_pairs`.

    Raises
    ------
    SnapshotError
        If there is no such channel.
    """
    machine, window = subject.machine, None if data.window is None else data.window.as_mounted
    pairs = chosen_pairs(machine, first, second)
    stated = theory(prediction.changes, prediction.nominal_reason, prediction.estimated_reason)
    if window is not None and not (first or second):
        pairs = tuple(pair for pair in pairs if all(state_name(one) in window.states for one in pair))
    if window is None or not pairs:
        return CorrelationSnapshot(
            **heading(subject, data),
            lags_s=(),
            method="samples",
            band_hz=None,
            pairs=(),
            theory=stated,
            reason=no_window(machine, data),
        )
    used = tuple(dict.fromkeys(channel for pair in pairs for channel in pair))
    check_held(machine, used, window.states)
    states = tuple(map(state_name, used))
    columns = [window.states.index(state) for state in states]
    places = [(states.index(state_name(one)), states.index(state_name(other))) for one, other in pairs]
    measured = measured_correlations(machine, window, [(columns[i], columns[j]) for i, j in places])
    gone = [number for number, (i, j) in enumerate(places) if data.missing & {states[i], states[j]}]
    measured.values[:, gone] = measured.errors[:, gone] = measured.outside_band[gone] = np.nan
    nominal, estimated = _predicted(prediction, used, places, measured)
    return CorrelationSnapshot(
        **heading(subject, data),
        lags_s=tuple(measured.lags_s.tolist()),
        method="samples" if measured.band_hz is None else "spectrum",
        band_hz=measured.band_hz,
        pairs=tuple(_pair(pair, number, measured, nominal, estimated, units) for number, pair in enumerate(pairs)),
        theory=stated,
        reason=unsent(machine, data),
    )


def _predicted(
    prediction: Prediction, channels: Sequence[Channel], places: list[tuple[int, int]], measured: MeasuredCorrelations
) -> tuple[FloatArray | None, FloatArray | None]:
    """Theory for pairs of channels, nominal and estimated; inclined sensors are sums over the states they measure."""
    states, parts = seen_by(channels)
    if parts is None:
        return prediction.correlations(states, places, measured.lags_s, measured.band_hz)
    n = len(states)
    every = [(i, j) for i in range(n) for j in range(n)]
    first, second = zip(*places, strict=True)
    nominal, estimated = (
        None if one is None else (parts @ one.reshape(-1, n, n) @ parts.T)[:, list(first), list(second)]
        for one in prediction.correlations(states, every, measured.lags_s, measured.band_hz)
    )
    return nominal, estimated


def _pair(
    pair: tuple[Channel, Channel],
    number: int,
    measured: MeasuredCorrelations,
    nominal: FloatArray | None,
    estimated: FloatArray | None,
    units: Units,
) -> CorrelationPair:
    unit, factor = product_unit(*pair, units)
    values, errors = measured.values[:, number], measured.errors[:, number]
    (z_nominal, series_nominal), (z_estimated, series_estimated) = (
        (None, None) if one is None else (_rms_z(values - one[:, number], errors), figures(factor * one[:, number]))
        for one in (nominal, estimated)
    )
    return CorrelationPair(
        first=pair[0].name,
        second=pair[1].name,
        unit=unit,
        measured=figures(factor * values),
        standard_error=figures(factor * errors),
        nominal=series_nominal,
        estimated=series_estimated,
        nominal_z=z_nominal,
        estimated_z=z_estimated,
        outside_band=figures(measured.outside_band[number : number + 1])[0],
    )


def _rms_z(difference: FloatArray, errors: FloatArray) -> float | None:
    if not np.all(errors > 0):
        return None
    return figures([np.sqrt(np.mean((difference / errors) ** 2))])[0]
