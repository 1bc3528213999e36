"""Rebuilds a window from recorded samples, as the monitor held it when they were live."""

from collections import deque
from dataclasses import replace

import numpy as np

from models.diagnosis.sensors.check import sensor_findings
from models.diagnosis.sensors.missing import no_data
from models.diagnosis.sensors.reference import implicated
from models.diagnosis.window.moments import Plan, plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.errors import RotorwatchError
from models.machine import MachineFile
from models.signals.block import SampleBlock
from models.signals.channels import Channel, state_name
from rotorwatch.records.health import Report
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault
from service.analysis.recorded import Recorded
from service.analysis.revolutions import Excerpt
from service.analysis.snapshots.machine import LatestData
from service.recordings.replay.source import RecordingSource

_LEAD_S = 10.0
"""Time before the window from which blocks are read: the first block needed may start before the window."""
_NEWEST_SAMPLES = 20_000
_NOT_EVALUATED = "no estimate: recorded samples are evaluated by an offline replay alone"


def recorded_window(
    source: RecordingSource,
    machine: MachineFile,
    recorded: str,
    until_ns: int | None,
    report: Report | None,
    *,
    lagged: bool,
) -> LatestData:
    """Rebuild the window of a recording that ends at a given time, or at the end of the recording.

    Parameters
    ----------
    recorded : str
        ``SITE/MACHINE`` under which the samples were recorded.
    report : Report or None
        The report on this window: the window then has exactly its samples, and theory uses its readings.
    lagged : bool
        Whether correlation functions are computed from samples rather than from spectra.

    Raises
    ------
    RotorwatchError
        If nothing was recorded before that time, or the channels differ from those of the machine file.
    """
    keys = source.machine(recorded)
    plan = plan_for(machine, lagged=lagged)
    end_ns = report.end_ns if report is not None else source.span(keys).end_ns if until_ns is None else until_ns
    first_ns = _first_ns(plan, end_ns, report)
    begin_ns = max(0, first_ns - round(_LEAD_S * 1e9))
    data = Recorded(source, keys, *source.between(f"{begin_ns}ns", f"{end_ns}ns", keys))
    channels, expected = data.descriptor.channels, machine.descriptor
    if channels != expected.channels or data.descriptor.rate_hz != expected.rate_hz:
        raise RotorwatchError(
            f"{machine.title}: {data.place} was recorded with {', '.join(one.name for one in channels)} "
            f"at {data.descriptor.rate_hz:g} Hz, or other units; expected those of the machine file, "
            f"{', '.join(one.name for one in expected.channels)} at {expected.rate_hz:g} Hz"
        )
    window = SlidingWindow(plan)
    newest: Excerpt | None = None
    known = () if report is None else report.sensors
    lost = implicated(one for one in known if one.kind is FaultKind.MISSING)
    sent = [one for one in data.sent(channels) if state_name(one) not in lost]
    for stretch in data.stretches(sent):
        part = _between(stretch, first_ns, end_ns)
        if not part.samples.size:
            continue
        whole = np.full((len(part.samples), len(channels)), np.nan)
        whole[:, [channels.index(one) for one in sent]] = part.samples
        newest = replace(part, samples=whole)
        window.gap()
        deque(window.feed(plan.to_si(np.nan_to_num(whole)), part.start_ns), maxlen=0)
    judged = window.again()
    found = None if judged is None else judged()
    if report is None:
        known = tuple(_missing(one) for one in channels if one not in sent)
        known = known if found is None else sensor_findings(found, None, machine.sensors, known)
    return LatestData(
        window=found,
        filled=window.filled if report is None else report.filled,
        parameters=() if report is None else report.parameters,
        why_not=_NOT_EVALUATED if report is None else report.reason,
        blocks=() if newest is None else (_block(newest),),
        sensors=known,
    )


def _first_ns(plan: Plan, end_ns: int, report: Report | None) -> int:
    """Time of the first sample of the window."""
    if report is not None and report.start_ns < report.end_ns:  # a window that is not full has no start
        return report.start_ns - round((plan.need - plan.fresh) * 1e9 / plan.rate_hz)
    return end_ns - round(((plan.hops - 1) * plan.stride + plan.need) * 1e9 / plan.rate_hz)


def _between(stretch: Excerpt, first_ns: int, end_ns: int) -> Excerpt:
    size = stretch.samples.shape[0]
    first, end = (round((one - stretch.start_ns) * stretch.rate_hz / 1e9) for one in (first_ns, end_ns))
    return stretch.part(min(max(first, 0), size), min(max(end, 0), size))


def _block(stretch: Excerpt) -> SampleBlock:
    newest = stretch.part(max(0, stretch.samples.shape[0] - _NEWEST_SAMPLES), stretch.samples.shape[0])
    return SampleBlock(newest.start_ns, 0, 0, newest.rate_hz, np.asarray(newest.samples, dtype=np.float64))


def _missing(channel: Channel) -> SensorFault:
    return SensorFault(states=(state_name(channel),), kind=FaultKind.MISSING, text=no_data([channel.name]), value=None)
