"""A gain that jumps in one channel alone, where no second sensor sees the same motion.

Between neighbouring hops the excitation may become louder and the machine may change, but that shows in every channel.
What only a sensor can do is to multiply one channel by a factor: its rotation-synchronous vector keeps its angle and
changes its length, its fluctuation changes by the same factor, and all other channels stay. Anything slower, or with
the other channels moving too, cannot be told from the machine and is left to the misfit of its model.
"""

import numpy as np

from models.diagnosis.pairs import motion_pairs
from models.diagnosis.sensors.finding import Naming
from models.diagnosis.window import WindowStatistics
from models.signals.block import FloatArray
from rotorwatch.records.sensor_faults import FaultKind
from rotorwatch.records.windows import SensorFault

__all__ = ["gain_jump"]

MOST_ERRORS = 6.0
"""Standard errors beyond which levels jump; the most probable of all moments is tested."""
_STAY = 3.0
"""Standard errors within which everything else must stay."""
LEAST_JUMP = 0.08
_FEWEST_SIDE = 3


def gain_jump(window: WindowStatistics, naming: Naming) -> list[SensorFault]:
    """Find channels without a second sensor of their motion whose gain jumped within the window."""
    vectors, n = window.rotation_vectors, len(window.states)
    paired = {column for pair in motion_pairs(window.states) for column in (pair.first, pair.second)}
    if vectors is None or n < 3 or vectors.shape[0] < 2 * _FEWEST_SIDE + 2 or not np.all(np.abs(vectors) > 0):
        return []
    length, angle = np.log(np.abs(vectors)), np.unwrap(np.angle(vectors), axis=0)
    angle = angle - np.median(angle, axis=1, keepdims=True)  # without a phase reference each hop has its own zero
    level = np.log(np.maximum(window.hop_waveform.rms[:, :n], np.finfo(float).tiny))
    findings = []
    for column in range(n):
        if column in paired:
            continue
        k = _moment(length[:, column])
        jumps, errors = _jumps(length, k)
        turns, turn_errors = _jumps(angle, k)
        levels, level_errors = _jumps(level, k)
        others = [i for i in range(n) if i != column]
        value = float(np.expm1(jumps[column]))
        z = float(abs(jumps[column]) / errors[column])
        alone = np.all(np.abs(jumps[others]) < np.maximum(_STAY * errors[others], abs(jumps[column]) / 4))
        quiet = np.all(np.abs(levels[others]) < np.maximum(_STAY * level_errors[others], abs(jumps[column]) / 4))
        straight = abs(turns[column]) < _STAY * turn_errors[column]
        along = abs(levels[column] - jumps[column]) < _STAY * level_errors[column]
        if z > MOST_ERRORS and abs(value) > LEAST_JUMP and alone and quiet and straight and along:
            state = window.states[column]
            text = (
                f"{naming.name(state)}: everything it measures changed by {value:+.0%} at once (± "
                f"{abs(value) / z:.1%}) while {naming.names(window.states[i] for i in others)} stayed as they were, "
                "expected a machine to show in more than one channel: its gain jumped"
            )
            findings.append(SensorFault(states=(state,), kind=FaultKind.GAIN, text=text, value=value, z=z))
    return findings


def _moment(series: FloatArray) -> int:
    """First hop after the most probable jump."""
    n = series.size
    sizes = [
        abs(series[k:].mean() - series[:k].mean()) * np.sqrt(k * (n - k) / n)
        for k in range(_FEWEST_SIDE, n - _FEWEST_SIDE + 1)
    ]
    return _FEWEST_SIDE + int(np.argmax(sizes))


def _jumps(series: FloatArray, k: int) -> tuple[FloatArray, FloatArray]:
    """Difference of the means after and before hop k, and its standard error from the scatter on either side."""
    before, after = series[:k], series[k:]
    left = ((before - before.mean(axis=0)) ** 2).sum(axis=0) + ((after - after.mean(axis=0)) ** 2).sum(axis=0)
    variance = left / (series.shape[0] - 2)
    error = np.sqrt(variance * (1 / k + 1 / (series.shape[0] - k)))
    return after.mean(axis=0) - before.mean(axis=0), np.maximum(error, np.finfo(float).tiny)
