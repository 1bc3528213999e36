"""All checks of the sensors on one window."""

from collections.abc import Iterable, Sequence

import numpy as np

from models.diagnosis.sensors.disagreement import BROKEN, gain_and_delay, swapped
from models.diagnosis.sensors.kinematics import PairReading, banded, read_pairs, same
from models.diagnosis.sensors.level import CHECKS, clipped, dropped, gain_jump, stuck
from models.diagnosis.sensors.noise import noisy
from models.diagnosis.sensors.phase import no_angle, phase_faults
from models.diagnosis.sensors.reference import PERFECT, Naming, SensorReference, implicated
from models.diagnosis.sensors.standstill import runs_down
from models.diagnosis.window.motion import motion_pairs
from models.diagnosis.window.statistics import WindowStatistics
from models.signals.channels import Channel
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

_ALL = 0.999  # part of a window from which on its shaft angle counts as missing throughout


def dead_sensors(
    window: WindowStatistics, channels: Iterable[Channel], missing: Sequence[SensorFault]
) -> tuple[SensorFault, ...]:
    """Vibration channels that are `missing` or stuck, in a window of any length."""
    known = {"theta", *implicated(missing)}
    found = stuck(window.as_mounted, Naming(channels), np.full(len(window.waveforms), True))
    return (*missing, *(one for one in found if known.isdisjoint(one.states)))


def sensor_findings(
    window: WindowStatistics,
    reference: SensorReference | None = None,
    channels: Iterable[Channel] = (),
    missing: Sequence[SensorFault] = (),
    *,
    standing: bool = False,
) -> tuple[SensorFault, ...]:
    """Check the sensors of a window.

    Without a reference only faults that no healthy sensor can show are found. A channel that is missing, stuck or
    clipped is not checked further. Channels are not compared with each other if the shaft angle jumps, slips, jitters
    or is missing from part of the window, because the synchronous part then remains in their spectra, or if the machine
    stood; the angle need not turn then. If the angle is missing throughout or stuck, none is found incoherent or noisy.
    """
    window, naming = window.as_mounted, Naming(channels)
    stood = np.full(len(window.waveforms), True) if standing else runs_down(window)
    findings = list(missing)

    def of_others(found: Iterable[SensorFault]) -> list[SensorFault]:
        bad = implicated(findings)
        return [one for one in found if bad.isdisjoint(one.states)]

    findings += of_others((*stuck(window, naming, stood), *dropped(window, naming)))
    findings += of_others(clipped(window, naming))  # a channel that drops to the end of its range is not clipped
    wrong_angle = [] if "theta" in implicated(missing) else no_angle(window, naming)
    if stood.any() or wrong_angle:
        return (*findings, *wrong_angle)
    for check in CHECKS:
        findings += of_others(check(window, naming, reference))
    bad = implicated(findings)
    if any("theta" in one.states and (one.value or 0.0) < _ALL * window.duration_s for one in missing):
        return tuple(findings)  # a hop in which the angle comes or goes keeps its synchronous part
    columns = [column for column, state in enumerate(window.states) if state not in bad]
    if "theta" not in bad:
        wrong_angle = phase_faults(window, columns, naming, reference)
        if wrong_angle:
            return (*findings, *wrong_angle)
    pairs = [pair for pair in motion_pairs(window.states) if {pair.first, pair.second} <= set(columns)]
    compared: list[PairReading] = []
    if pairs:
        bands = banded(window, pairs)
        exchanged, explained = swapped(window, dict(zip(pairs, same(bands).tolist(), strict=True)), naming, reference)
        findings += exchanged
        leads = {} if reference is None else {(one.first, one.second): one.lead_rad_s for one in reference.pairs}
        compared = [one for one in read_pairs(window, pairs, bands, leads) if one.pair not in explained]

    faults = _incoherent(window, naming, compared, reference)
    broken = {one.states for one in faults}
    readings = [one for one in compared if (one.first, one.second) not in broken]
    if "theta" not in bad:  # else the synchronous part is still there, and its run-out is in the displacement alone
        findings += faults
    findings += gain_and_delay(window, readings, naming, reference)
    findings += of_others(gain_jump(window, naming))  # of channels that are in no reading
    bad = implicated(findings)
    if "theta" not in bad:  # the synchronous part that a wrong angle leaves in the spectra looks like noise
        findings += noisy(window, readings, naming, reference, bad)
    return tuple(findings)


def _incoherent(
    window: WindowStatistics, naming: Naming, compared: Sequence[PairReading], reference: SensorReference | None
) -> list[SensorFault]:
    """Pairs that share less of their motion than healthy ones."""

    def expected(one: PairReading) -> float:
        known = None if reference is None else reference.pair(one.first, one.second)
        return (known or PERFECT).shared

    found = [one for one in compared if one.shared < BROKEN * expected(one)]
    cause = "noise, a loose sensor, or a wrong channel"
    if len(found) == len(compared) and not np.isfinite(window.hop_speed_rad_s).any():
        cause += "; or the machine stands, as no rotation is found"
    return [
        SensorFault(
            states=(one.first, one.second),
            kind=FaultKind.INCOHERENT,
            text=(
                f"{naming.name(one.second)} and {naming.name(one.first)} measure the same motion but share only "
                f"{one.shared:.2f} of it, expected nearly 1: {cause}"
            ),
            value=one.shared,
        )
        for one in found
    ]
