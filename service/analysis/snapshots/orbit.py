"""1x orbits of the latest window, and unfiltered orbits of the newest revolutions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine, MachineFile
from models.physics.response import synchronous_response
from models.physics.rotor import STATES, RotorParameters, changed
from models.signals.block import ComplexArray, SampleBlock
from models.signals.channels import Channel, state_name
from rotorwatch.records.snapshots import OrbitEllipse, OrbitSnapshot, PathSamples, PlaceOrbit, RunningSpeedVector, Units
from service.analysis.orbit import MODELLED, Ellipse, no_pair, orbit_pairs, phase_lag_deg, planes_of
from service.analysis.prediction import NO_PARAMETERS, NOTHING_READ, Prediction, read_changes
from service.analysis.revolutions import Excerpt, Revolutions, newest_revolutions
from service.analysis.snapshots.channels import figures, known_figures
from service.analysis.snapshots.machine import LatestData, MachineSnapshots, heading, no_window, unsent

_MOST_SAMPLES = 20_000
_NO_SPEED = "the speed of rotation is not known"


@dataclass(frozen=True, slots=True)
class _Vectors:
    """1x vectors q of x = Re{q e^{jθ}} of all states in the window, SI."""

    mean: ComplexArray  # (n,)
    hops: ComplexArray  # (n_hops, n), vectors of every hop; their scatter gives standard errors
    direction: int  # 1 if θ grows, -1 if it falls
    # Whether θ is the measured shaft angle; else its origin is arbitrary, and the sense of rotation unknown.
    absolute: bool


def orbit_snapshot(
    of: MachineSnapshots, data: LatestData, revolutions: int = 0, units: Units = "channel"
) -> OrbitSnapshot:
    """Orbits at every location with displacements in both directions; paths over `revolutions` whole revolutions."""
    machine, known, window = of.machine, of.known, data.window
    there = orbit_pairs(machine.sensors)
    pairs = [pair for pair in there if not data.lost & {state_name(one) for one in pair}]
    places = [pair for pair in pairs if pair[0].location in MODELLED]
    path = _newest_path(machine, data.blocks, revolutions, None if window is None else window.speed_rad_s)
    changes = read_changes(data.parameters)
    lacking = NO_PARAMETERS if known is None else ""
    estimated_reason = lacking or ("" if changes else data.why_not or NOTHING_READ)
    vectors = None if window is None or "theta" in data.lost else _vectors(window)
    if not there:
        reason = f"{machine.title}: {no_pair(machine.sensors)}"
    elif pairs != there or "theta" in data.lost:
        reason = unsent(machine, data)
    elif not places:
        reason = ""  # the window does not hold these locations; `path_reason` covers them
    elif window is None:
        reason = no_window(machine, data)
    else:
        reason = _NO_SPEED if vectors is None else ""
    predicted: list[ComplexArray | None] = [None, None]
    if known is not None and window is not None and vectors is not None:
        predicted[0] = _predicted(known, known.rotor, window)
        predicted[1] = None if estimated_reason else _predicted(known, changed(known.rotor, changes), window)
    others = [(pair, _path(machine, path, pair, units)) for pair in pairs if pair not in places]
    return OrbitSnapshot(
        **heading(of.identity, data, Prediction(known, None, changes, lacking, estimated_reason)),
        speed_source="unknown" if window is None else window.speed_source,
        orbits=tuple(
            _window_orbit(pair, window, vectors, predicted, _path(machine, path, pair, units), units) for pair in places
        )
        + tuple(_path_orbit(pair, path.excerpt, samples, units) for pair, samples in others if samples is not None),
        revolutions=path.count,
        path_start_ns=None if path.excerpt is None else path.excerpt.start_ns,
        pulses_s=known_figures(path.pulses / machine.rate_hz),
        reason=reason,
        path_reason=path.reason if there else reason,
    )


def _vectors(window: WindowStatistics) -> _Vectors | None:
    if window.synchronous is not None and window.hop_synchronous is not None:
        return _Vectors(window.synchronous, window.hop_synchronous, 1 if window.speed_rad_s >= 0 else -1, absolute=True)
    if window.relative_synchronous is None:
        return None
    seen = window.relative_synchronous[np.any(window.relative_synchronous != 0, axis=1)]
    return _Vectors(seen.mean(axis=0), seen, 1, absolute=False) if seen.shape[0] else None


def _window_orbit(
    pair: tuple[Channel, Channel],
    window: WindowStatistics | None,
    vectors: _Vectors | None,
    predicted: Sequence[ComplexArray | None],
    path: PathSamples | None,
    units: Units,
) -> PlaceOrbit:
    y = z = ellipse = nominal = estimated = None
    if window is not None and vectors is not None:
        factor = 1.0 if units == "SI" else 1 / pair[0].to_si
        states = ("y1", "z1") if pair[0].location == "bearing" else ("y2", "z2")
        at, rows = ([every.index(state) for state in states] for every in (window.states, STATES))
        y, z = (_vector(name, column, vectors, factor) for name, column in zip(planes_of(pair).names, at, strict=True))
        ellipse = _ellipse(factor * vectors.mean[at], vectors)
        nominal, estimated = (None if q is None else _ellipse(factor * q[rows], vectors) for q in predicted)
    return PlaceOrbit(
        location=pair[0].location,
        unit="m" if units == "SI" else pair[0].unit,
        y=y,
        z=z,
        ellipse=ellipse,
        nominal=nominal,
        estimated=estimated,
        path=path,
    )


def _path_orbit(pair: tuple[Channel, Channel], excerpt: Excerpt | None, path: PathSamples, units: Units) -> PlaceOrbit:
    """Orbit of the newest revolutions at a location that neither the model nor the window has."""
    ellipse = None
    if excerpt is not None and excerpt.angle_rad is not None:
        motion = np.array([path.y, path.z], dtype=np.float64)
        q = 2 * (motion * np.exp(-1j * excerpt.angle_rad)).mean(axis=1)
        ellipse = _ellipse(q, _Vectors(q, q[None], -1 if excerpt.speed_rad_s < 0 else 1, absolute=True))
    unit = "m" if units == "SI" else pair[0].unit
    return PlaceOrbit(
        location=pair[0].location, unit=unit, y=None, z=None, ellipse=ellipse, nominal=None, estimated=None, path=path
    )


def _vector(name: str, column: int, vectors: _Vectors, factor: float) -> RunningSpeedVector:
    q = complex(vectors.mean[column])
    hops = vectors.hops[:, column]
    count = hops.shape[0]
    error = phase_error = None
    if count > 1 and abs(q) > 0:
        along = (hops - hops.mean()) * np.conj(q) / abs(q)
        error = figures([factor * along.real.std(ddof=1) / np.sqrt(count)])[0]
        phase_error = figures([np.degrees(along.imag.std(ddof=1) / np.sqrt(count) / abs(q))])[0]
    return RunningSpeedVector(
        channel=name,
        amplitude=_rounded(factor * abs(q)),
        amplitude_error=error,
        phase_lag_deg=_rounded(phase_lag_deg(q, vectors.direction)) if vectors.absolute else None,
        phase_error_deg=phase_error if vectors.absolute else None,
    )


def _predicted(known: Machine, rotor: RotorParameters, window: WindowStatistics) -> ComplexArray:
    """1x vectors of all states due to the unbalance, at the window's speed."""
    q1, q2 = synchronous_response(rotor, window.speed_rad_s)
    return np.asarray((q1 - 1j * q2) * np.exp(1j * known.operation.unbalance_phase_rad), dtype=np.complex128)


def _ellipse(q: ComplexArray, vectors: _Vectors) -> OrbitEllipse:
    found = Ellipse(complex(q[0]), complex(q[1]))
    return OrbitEllipse(
        semi_major=_rounded(found.semi_major),
        semi_minor=_rounded(found.semi_minor),
        tilt_deg=_rounded(found.tilt_deg),
        sense="y to z" if (found.precession == "forward") == (vectors.direction > 0) else "z to y",
        precession=found.precession if vectors.absolute else None,
    )


def _newest_path(
    machine: MachineFile, blocks: tuple[SampleBlock, ...], revolutions: int, speed_rad_s: float | None
) -> Revolutions:
    if not revolutions:
        return Revolutions("none were asked for")
    if not blocks:
        return Revolutions("no samples have come in")
    return newest_revolutions(Excerpt.of_blocks(blocks, machine.descriptor), revolutions, speed_rad_s, _MOST_SAMPLES)


def _path(machine: MachineFile, path: Revolutions, pair: tuple[Channel, Channel], units: Units) -> PathSamples | None:
    if path.excerpt is None:
        return None
    names = [channel.name for channel in machine.sensors]
    factor = 1.0 if units == "SI" else 1 / pair[0].to_si
    samples = path.excerpt.samples
    y, z = planes_of(pair).turned(np.stack([samples[:, names.index(one.name)] * one.to_si * factor for one in pair]))
    if not np.isfinite(y + z).all():
        return None  # a sensor is not connected
    times_s = np.arange(y.size) / machine.rate_hz
    return PathSamples(times_s=known_figures(times_s), y=known_figures(y - y.mean()), z=known_figures(z - z.mean()))


def _rounded(value: float) -> float:
    return figures([value])[0] or 0.0
