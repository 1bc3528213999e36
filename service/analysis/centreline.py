"""Where the shaft is on average, across its axis: the gaps of two probes, over speed or time."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.errors import RotorwatchError
from models.signals.block import FloatArray
from models.signals.channels import Channel
from service.analysis.orbit import in_planes
from service.analysis.past import Past
from service.analysis.recorded import Sampled, begins_again
from service.analysis.revolutions import newest_revolutions

_MOST_POINTS = 400
_LEAST_OF_ALL = 0.5
"""Part of a stretch that a shorter one before a gap must have."""


@dataclass(frozen=True, slots=True)
class Centreline:
    """Mean positions at some places, in order of time (API 670: average shaft centreline)."""

    pairs: tuple[tuple[Channel, Channel], ...]
    each_s: float
    time_ns: npt.NDArray[np.int64]  # (n,), middle of the samples of each
    speed_rad_s: FloatArray  # (n,), nan without a shaft angle
    # (n, n_pairs).
    y_um: FloatArray
    z_um: FloatArray


def _past_centreline(data: Past, pairs: Sequence[tuple[Channel, Channel]]) -> Centreline:
    """Mean positions in the windows of the history, as the monitor reported them.

    Raises
    ------
    RotorwatchError
        If there are not two windows with all of them.
    """
    channels = [channel for pair in pairs for channel in pair]
    rows = []
    for report in data.reports:
        means = {one.channel: one.mean for one in report.levels}
        values = [means.get(channel.name) for channel in channels]
        if None not in values:
            rows.append((report.start_ns, report.end_ns, report.speed_rad_s, values))
    if len(rows) < 2:
        raise RotorwatchError(
            f"{data.place}: {len(rows)} reports of {data.name} have the mean positions of "
            f"{', '.join(channel.name for channel in channels)}, expected at least 2 for a centreline"
        )
    start, end, speed, means_ = zip(*rows, strict=True)
    middle_ns = (np.array(start, dtype=np.int64) + np.array(end, dtype=np.int64)) // 2
    y_um, z_um = in_planes(np.array(means_, dtype=np.float64), pairs)
    return Centreline(
        tuple(pairs), (end[-1] - start[-1]) / 1e9, middle_ns, np.array(speed, dtype=np.float64), y_um, z_um
    )


def read_centreline(data: Sampled | Past, pairs: Sequence[tuple[Channel, Channel]], each_s: float) -> Centreline:
    """Means over every so many seconds, in long recordings over longer ones; of a history those of its windows.

    Raises
    ------
    RotorwatchError
        If there are not two such stretches.
    """
    if isinstance(data, Past):
        return _past_centreline(data, pairs)
    each_s = max(each_s, (data.to_ns - data.from_ns) / 1e9 / _MOST_POINTS)
    rows: list[tuple[int, float, FloatArray]] = []
    for stretch in data.stretches([channel for pair in pairs for channel in pair], each_s):
        if stretch.length_s < _LEAST_OF_ALL * each_s:
            continue
        # Of whole revolutions, where there are any, so that vibration at running speed has no part in the mean.
        whole = newest_revolutions(stretch, stretch.samples.shape[0]).excerpt or stretch
        middle_ns = (whole.start_ns + whole.end_ns) // 2
        while rows and begins_again(rows[-1][0], middle_ns):
            rows.pop()  # of several runs at the same time the one that was recorded last is shown
        rows.append((middle_ns, stretch.speed_rad_s, whole.samples.mean(axis=0)))
    if len(rows) < 2:
        raise RotorwatchError(
            f"{data.place}: {len(rows)} stretches of {each_s:g} s of {data.name} without a gap, expected at least 2 "
            "for a centreline; a shorter --window may do"
        )
    times, speeds, means = zip(*rows, strict=True)
    y_um, z_um = in_planes(np.stack(means), pairs)
    return Centreline(tuple(pairs), each_s, np.array(times, dtype=np.int64), np.array(speeds), y_um, z_um)
