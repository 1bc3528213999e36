"""What the likelihood compares: one motion per degree of freedom, in groups of neighbouring frequency bins.

**Bins.** The spectrum that Hann-windowed segments estimate is not the spectrum at the bin but its average under the
window's kernel. On the grid of the segment's own frequencies that kernel is (1, 4, 1)/6, exactly so for a motion that
decays within a segment; a motion that rings longer needs a finer grid. A theory that is averaged the same way
has no bias from leakage (P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967), for the estimate; A. M. Sykulski et
al., Biometrika 106 (2019), for comparing with the expectation). Averaging further over a few neighbouring bins is
linear too, and saves time where the spectrum is smooth.

**Motions.** A displacement x and a velocity v of the same degree of freedom are one motion measured twice: v = jωx but
for sensor noise. If both were compared with theory, the small difference that finite segments cause would count as
further information, which it is not: near resonances it repeats the neighbouring bins. In units in which both noises
are one,

    z = (x - jr v) / √(1 + r²),    r = ω · (unit of x) / (unit of v),

is a rotation: its noise is one again, and it holds everything that the pair says about the motion. The rest,
(v - jr x) / √(1 + r²), holds noise and, if the gain of a sensor has drifted, the difference of the two gains.

**Accelerations** become velocities. In the spectrum, integration is a division by jω, exact at every frequency of the
window's band (``band_hz`` of the machine file) and valid only there. Nothing is filtered in time.
"""

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from models.diagnosis.window.moments import divided
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine
from models.physics.rotor import STATE_INDEX, natural_frequencies
from models.signals.block import BoolArray, ComplexArray, FloatArray
from models.signals.channels import ACCELERATIONS

# Independent averages per half-overlapped Hann segment and bin: one over the sum of the squared correlations with all
# neighbouring segments and bins.
AVERAGES_PER_BIN = 0.4737
# Squared correlations of a bin with itself and the next two, within a segment plus twice with a neighbouring segment.
_SCATTER = AVERAGES_PER_BIN * np.array([1 + 2 / 36, 4 / 9 + 2 * 0.0200, 1 / 36 + 2 * 0.0069])
_KERNEL = np.array([1.0, 4.0, 1.0]) / 6
# Decay over a segment, in nepers, of the longest-ringing mode in the band, below which a finer grid is used; and the
# least decay over the time 1 / spacing of that grid, whose sum over the mode's line is off by twice exp(-decay).
_RINGING, _LEAST_DECAY = 8.0, 7.0
_FINEST = 16  # nodes per bin, at most
_PER_BANDWIDTH = 0.5  # width of a group over the half-power bandwidth of the nearest mode


@dataclass(frozen=True, slots=True)
class BinGroups:
    """Neighbouring bins averaged into one."""

    edges: tuple[tuple[int, int], ...]  # first bin and the one after the last, of every group
    bins: FloatArray  # (n_groups,), bins per group
    centre_hz: FloatArray  # (n_groups,), mean frequency
    # (n_groups, n_nodes): frequencies at which the theory is needed; padded with copies of weight zero
    nodes_hz: FloatArray
    weights: FloatArray  # (n_groups, n_nodes), weight of each node in the group's expected spectrum
    # (n_groups, n_groups): squared correlations of the groups' scatter, relative to the variance that
    # `AVERAGES_PER_BIN` implies: a group of few bins scatters less than that, and correlates with its neighbours
    shared: FloatArray
    speeds: int = 1  # number of speeds that the theory is averaged over; all nodes are repeated for each

    def average(self, spectrum: ComplexArray) -> ComplexArray:
        """Average estimated cross-spectra over each group, shape (n_groups, n, n)."""
        places = np.array(self.edges).ravel()
        # Every other sum is of bins between two groups and is dropped; the last group may end with the band.
        sums = np.add.reduceat(spectrum, places[: -1 if places[-1] == spectrum.shape[0] else None], axis=0)[::2]
        return divided(np.ascontiguousarray(sums), self.bins[:, None, None])

    def cross_spectra(self, segments: ComplexArray) -> ComplexArray:
        """Average from Fourier coefficients, shape (n_bins, n_segments, n), which is cheaper for few segments."""
        m, runs = segments.shape[-1], _runs(self.edges)
        alike = [segments[first : first + n * width].reshape(n, -1, m) for first, n, width in runs]
        sums = np.concatenate([one.swapaxes(1, 2) @ one.conj() for one in alike])
        return divided(sums, segments.shape[1] * self.bins[:, None, None])

    def same_as(self, other: "BinGroups") -> bool:
        """Whether other groups hold the same bins at the same frequencies, for as many speeds."""
        alike = self.edges == other.edges and self.speeds == other.speeds
        return alike and np.array_equal(self.centre_hz, other.centre_hz)


@lru_cache(maxsize=8)
def _runs(edges: tuple[tuple[int, int], ...]) -> list[tuple[int, int, int]]:
    """First bin, number and width of groups that follow each other without a gap and hold equally many bins."""
    runs: list[tuple[int, int, int]] = []
    for first, end in edges:
        at, count, width = runs.pop() if runs else (first, 0, end - first)
        joins = width == end - first and at + count * width == first
        runs += [(at, count + 1, width)] if joins else [(at, count, width), (first, 1, end - first)]
    return runs


def group_bins(
    frequencies_hz: FloatArray, machine: Machine, excluded: BoolArray, widest_hz: float, speeds: int = 1
) -> BinGroups:
    """Group evenly spaced bins: narrow near the machine's nominal modes, at most `widest_hz` elsewhere.

    Bins that are excluded, shape (n_bins,), belong to no group. The theory is averaged over a number of `speeds`.
    """
    spacing = frequencies_hz[1] - frequencies_hz[0]
    modes_hz, damping = natural_frequencies(machine.rotor, machine.operation.speed_rad_s)
    bandwidth = np.sqrt((damping * modes_hz) ** 2 + ((frequencies_hz[:, None] - modes_hz) / 2) ** 2)
    width_hz = np.minimum(_PER_BANDWIDTH * bandwidth.min(axis=1), widest_hz)
    most = np.maximum(1, np.round(width_hz / spacing)).astype(int)
    edges = []
    first = 0
    while first < frequencies_hz.size:
        end = first
        while end < frequencies_hz.size and not excluded[end] and end - first < most[first]:
            end += 1
        if end > first:
            edges.append((first, end))
        first = max(end, first + 1)
    in_band = modes_hz < 1.2 * frequencies_hz[-1]
    decay = float(np.min(2 * np.pi * (damping * modes_hz)[in_band], initial=np.inf)) / spacing
    finer = 1 if decay > _RINGING else min(_FINEST, 2 ** math.ceil(math.log2(max(2.0, _LEAST_DECAY / decay))))
    kernel = _KERNEL if finer == 1 else _fine_kernel(finer)
    reach, bins = (kernel.size - 1) // 2, np.array([end - first for first, end in edges], dtype=np.float64)
    n_nodes = finer * (int(bins.max()) - 1) + kernel.size
    nodes_hz, weights = np.empty((len(edges), n_nodes)), np.zeros((len(edges), n_nodes))
    for group, (first, end) in enumerate(edges):
        comb = np.zeros(finer * (end - first - 1) + 1)
        comb[::finer] = 1 / (end - first)
        held = np.convolve(comb, kernel)
        weights[group, : held.size] = held
        steps = np.minimum(np.arange(n_nodes), held.size - 1) - reach
        nodes_hz[group] = np.abs(frequencies_hz[first] + spacing / finer * steps)
    return BinGroups(
        edges=tuple(edges),
        bins=bins,
        centre_hz=np.array([frequencies_hz[first:end].mean() for first, end in edges]),
        nodes_hz=np.tile(nodes_hz, speeds),
        weights=np.tile(weights, speeds) / speeds,
        shared=_shared_scatter(edges, frequencies_hz.size) / np.sqrt(np.outer(bins, bins)),
        speeds=speeds,
    )


@lru_cache
def _fine_kernel(finer: int) -> FloatArray:
    """Kernel of a Hann window out to two and a half bins, with `finer` nodes per bin; sums to one."""
    offsets = np.arange(-5 * finer // 2, 5 * finer // 2 + 1) / finer
    beside = np.abs(offsets) == 1
    kernel = np.where(beside, 0.5, np.sinc(offsets) / np.where(beside, 1, 1 - offsets**2)) ** 2
    return np.asarray(kernel / kernel.sum(), dtype=np.float64)


def _shared_scatter(edges: list[tuple[int, int]], n_bins: int) -> FloatArray:
    group_of = np.full(n_bins, -1)
    for group, (first, end) in enumerate(edges):
        group_of[first:end] = group
    shared = np.zeros((len(edges), len(edges)))
    for apart, correlation in enumerate(_SCATTER):
        left, right = group_of[: n_bins - apart], group_of[apart:]
        both = (left >= 0) & (right >= 0)
        np.add.at(shared, (left[both], right[both]), correlation)
        if apart:
            np.add.at(shared, (right[both], left[both]), correlation)
    return shared


_ABSENT = -1
_GAIN_FLOOR = 0.005  # error of a pair's gain that no window length removes: unequal noise and leakage look like it


class Motions:
    """Measured degrees of freedom, and how the measured states combine into them.

    `scale`, shape (n_states,), is the unit of each state. The units should be in the ratio of the sensors' noise; for
    want of that, they are the mean amplitudes in the band.
    """

    def __init__(self, states: tuple[str, ...], scale: FloatArray) -> None:
        self.states, self.scale = states, scale
        column = {STATE_INDEX[name]: at for at, name in enumerate(states)}
        self.dofs = np.array([dof for dof in range(6) if dof in column or dof + 6 in column])
        self.n = self.dofs.size
        self._x = np.array([column.get(dof, _ABSENT) for dof in self.dofs])
        self._v = np.array([column.get(dof + 6, _ABSENT) for dof in self.dofs])
        self._has_x, self._has_v = self._x != _ABSENT, self._v != _ABSENT
        self._unit_x = np.where(self._has_x, scale[self._x], 1.0)
        self._unit_v = np.where(self._has_v, scale[self._v], 1.0)

    def _r(self, w: FloatArray) -> FloatArray:
        """Ratio r of the module's docstring, shape (…, n); 0 for a motion that only one sensor measures."""
        return np.asarray(
            np.where(self._has_x & self._has_v, w[..., None] * self._unit_x / self._unit_v, 0.0), dtype=np.float64
        )

    def factor(self, w: FloatArray, centre: FloatArray) -> ComplexArray:
        """Motion per unit displacement at angular frequencies w, rad/s, shape (*w.shape, n).

        The states are combined with the weights of `centre`, the frequency of the group that w belongs to.
        """
        at_centre = self._r(centre)
        pair = (1 + at_centre * self._r(w)) / np.sqrt(1 + at_centre**2)
        return np.asarray(np.where(self._has_x, pair / self._unit_x, 1j * w[..., None] / self._unit_v))

    def combine(self, w: FloatArray) -> ComplexArray:
        """Matrix from measured states, SI, to motions at frequencies w, shape (*w.shape, n, n_states)."""
        matrix = np.zeros((*w.shape, self.n, len(self.states)), dtype=np.complex128)
        r = self._r(w)
        root = np.sqrt(1 + r**2)
        for at in range(self.n):
            if self._has_x[at]:
                matrix[..., at, self._x[at]] = 1 / root[..., at] / self._unit_x[at]
            if self._has_v[at]:
                share = -1j * r[..., at] / root[..., at] if self._has_x[at] else 1.0
                matrix[..., at, self._v[at]] = share / self._unit_v[at]
        return matrix

    def shares(self, w: FloatArray) -> dict[str, tuple[int, FloatArray]]:
        """For each state, the motion it is part of and its share of that motion's amplitude at frequencies w."""
        r2 = self._r(w) ** 2
        shares = {}
        for at in range(self.n):
            if self._has_x[at]:
                shares[self.states[self._x[at]]] = at, 1 / (1 + r2[..., at])
            if self._has_v[at]:
                share = r2[..., at] / (1 + r2[..., at]) if self._has_x[at] else np.ones_like(r2[..., at])
                shares[self.states[self._v[at]]] = at, share
        return shares

    def rest(self, states: ComplexArray, w: FloatArray) -> FloatArray:
        """Power that the two sensors of a motion do not share, shape (n_groups, n); infinite for a single sensor.

        `states` are the cross-spectra of the states, SI, shape (n_groups, n_states, n_states).
        """
        r = self._r(w)
        left = np.full(r.shape, np.inf)
        for at in np.flatnonzero(self._has_x & self._has_v):
            x, v = self._x[at], self._v[at]
            of_x, of_v = (states[:, one, one].real / self.scale[one] ** 2 for one in (x, v))
            between = states[:, v, x] / (self.scale[x] * self.scale[v])
            # |v - jr x|² / (1 + r²)
            left[:, at] = (of_v + r[:, at] ** 2 * of_x - 2 * r[:, at] * between.imag) / (1 + r[:, at] ** 2)
        return left

    def mismatches(
        self, states: ComplexArray, w: FloatArray, averages: FloatArray
    ) -> list[tuple[tuple[str, str], float, float]]:
        """Compare displacement and velocity of every degree of freedom that has both.

        With the two states comes the gain of the velocity relative to that of the displacement, minus one, and the same
        in standard errors.

        With gains 1 and 1 + δ, the rest d = (v - jr x)/√(1 + r²) of a pair contains jr δ z/(1 + r²) of its motion z. A
        least-squares regression gives δ, and its residual the standard error.

        `states` are the cross-spectra of the states, SI, shape (n_groups, n_states, n_states); `averages` is the number
        of independent averages in each group.
        """
        both = np.flatnonzero(self._has_x & self._has_v)
        r, x, v = self._r(w)[:, both], self._x[both], self._v[both]
        of_x, of_v, of_both = (states[:, i, j] / (self.scale[i] * self.scale[j]) for i, j in ((x, x), (v, v), (v, x)))
        of_x, of_v, turned, share = of_x.real, of_v.real, of_both.imag, 1 / (1 + r**2)
        zz = (of_x + r**2 * of_v + 2 * r * turned) * share
        dd = (of_v + r**2 * of_x - 2 * r * turned) * share
        dz = (r * (of_v - of_x) + (1 - r**2) * turned) * share  # imaginary part of d z*, as the regressor is imaginary
        regressor = r * share
        power = regressor**2 * zz
        total = averages @ power
        delta = averages @ (dz * regressor) / total
        # Residual power is taken group by group: leakage makes it largest where the motion is. Where noise is much of
        # the motion, unequal noise of the two sensors looks like a difference of gain.
        noise = averages @ (regressor**2 * dd) / total
        error = np.sqrt(averages @ (power * dd) / 2 / total**2 + noise**2 + _GAIN_FLOOR**2)
        pairs = [(self.states[i], self.states[j]) for i, j in zip(x.tolist(), v.tolist(), strict=True)]
        return list(zip(pairs, delta.tolist(), (delta / error).tolist(), strict=True))


def integrated(window: WindowStatistics) -> WindowStatistics:
    """Return the window with velocities in place of accelerations; unchanged if no acceleration is measured.

    An acceleration is left out if the same velocity is measured, too: it is the same motion with more noise at low
    frequencies. Correlations are kept only at lag zero, where they follow from the spectra.
    """
    if not any(name in ACCELERATIONS for name in window.states):
        return window
    velocity = {name: name.replace("_ddot", "_dot") for name in window.states}
    window = window.of(tuple(name for name, of in velocity.items() if of == name or of not in velocity))
    made = np.isin(window.states, ACCELERATIONS)
    w = 2 * np.pi * window.frequencies_hz
    turn = np.where(made, 1 / (1j * w[:, None]), 1.0)
    spectrum = window.spectrum * turn[:, :, None] * turn[:, None, :].conj()
    step_hz = float(window.frequencies_hz[1] - window.frequencies_hz[0])
    correlation = 2 * step_hz * spectrum.real.sum(axis=0)[np.newaxis]
    at_speed = (
        np.where(made, 1 / (1j * window.speed_rad_s), 1.0) if np.isfinite(window.speed_rad_s) else np.ones(made.size)
    )
    hops = window.hop_correlation.shape[0]
    return replace(
        window.with_vectors(lambda vectors: np.asarray(vectors * at_speed, dtype=np.complex128)),
        states=tuple(velocity[name] for name in window.states),
        lags_s=window.lags_s[:1],
        correlation=correlation,
        hop_correlation=np.repeat(correlation[np.newaxis], hops, axis=0),
        spectrum=spectrum,
        segments=window.segments * turn[:, None],
    )
