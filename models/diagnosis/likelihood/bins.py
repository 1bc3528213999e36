"""Groups of neighbouring frequency bins, and what a segment's spectrum is expected to be in them.

The spectrum that Hann-windowed segments estimate is not the spectrum at the bin but its average under the window's
kernel. On the grid of the segment's own frequencies that kernel is (1, 4, 1)/6, exactly so for a motion that is
forgotten within a segment; a motion that rings longer needs a grid twice as fine. A theory that is averaged the same
way has no bias from leakage (P. D. Welch, IEEE Trans. Audio Electroacoust. 15 (1967), for the estimate; A. M. Sykulski
et al., Biometrika 106 (2019), for comparing with the expectation). Averaging further over a few neighbouring bins is
linear too, and saves time where the spectrum is smooth.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from models.diagnosis.moments import ComplexArray
from models.machine import Machine
from models.physics.matrices import system_A
from models.signals.block import FloatArray

__all__ = ["AVERAGES_PER_BIN", "BinGroups", "group_bins", "natural_frequencies"]

AVERAGES_PER_BIN = 0.4737
"""Independent averages per half-overlapped Hann segment and bin: one over the sum of the squared correlations with all
neighbouring segments and bins."""

_SCATTER = AVERAGES_PER_BIN * np.array([1 + 2 / 36, 4 / 9 + 2 * 0.0200, 1 / 36 + 2 * 0.0069])
"""Squared correlations with the bin itself and the two next to it: within a segment, and twice with a neighbour."""

_KERNEL = np.array([1.0, 4.0, 1.0]) / 6
_OFFSETS = np.arange(-2.5, 2.6, 0.5)  # in bins
_FINE_KERNEL = (
    np.where(np.abs(_OFFSETS) == 1, 0.5, np.sinc(_OFFSETS) / np.where(np.abs(_OFFSETS) == 1, 1, 1 - _OFFSETS**2)) ** 2
)
_FINE_KERNEL = _FINE_KERNEL / _FINE_KERNEL.sum()
_RINGING = 8.0
"""Decay over a segment, in nepers, of the longest ringing mode in the band, below which the fine grid is used."""
_PER_BANDWIDTH = 0.5
"""Width of a group over the half-power bandwidth of the nearest mode."""


@dataclass(frozen=True, slots=True)
class BinGroups:
    """Neighbouring bins averaged into one.

    Attributes
    ----------
    edges : tuple of (int, int)
        First bin and the one after the last, of every group.
    bins : ndarray, shape (n_groups,)
        Bins per group.
    centre_hz : ndarray, shape (n_groups,)
        Mean frequency.
    nodes_hz : ndarray, shape (n_groups, n_nodes)
        Frequencies at which the theory is needed; padded with copies of weight zero.
    weights : ndarray, shape (n_groups, n_nodes)
        What each of them contributes to the group's expected spectrum.
    shared : ndarray, shape (n_groups, n_groups)
        Squared correlations of the groups' scatter, in units of what `AVERAGES_PER_BIN` says of each: a group of few
        bins scatters less than that, and together with its neighbours.
    """

    edges: tuple[tuple[int, int], ...]
    bins: FloatArray
    centre_hz: FloatArray
    nodes_hz: FloatArray
    weights: FloatArray
    shared: FloatArray

    def average(self, spectrum: ComplexArray) -> ComplexArray:
        """Average estimated cross-spectra over each group, shape (n_groups, n, n)."""
        places = np.array(self.edges).ravel()
        # Every other sum is that of the bins between two groups; the end of the last may be the end of the band.
        sums = np.add.reduceat(spectrum, places[: -1 if places[-1] == spectrum.shape[0] else None], axis=0)[::2]
        return np.asarray(sums / self.bins[:, None, None], dtype=np.complex128)

    def same_as(self, other: "BinGroups") -> bool:
        """Whether other groups hold the same bins at the same frequencies."""
        return self.edges == other.edges and np.array_equal(self.centre_hz, other.centre_hz)


def natural_frequencies(machine: Machine) -> tuple[FloatArray, FloatArray]:
    """Natural frequencies (Hz) and damping ratios of the nominal rotor at nominal speed."""
    poles = np.linalg.eigvals(system_A(machine.rotor, machine.operation.speed_rad_s))
    poles = poles[poles.imag > 0]
    return np.abs(poles) / (2 * np.pi), -poles.real / np.abs(poles)


def group_bins(
    frequencies_hz: FloatArray, machine: Machine, excluded: npt.NDArray[np.bool_], widest_hz: float
) -> BinGroups:
    """Group bins: narrow near the modes, at most `widest_hz` elsewhere.

    Parameters
    ----------
    frequencies_hz : ndarray, shape (n_bins,)
        Evenly spaced.
    machine : Machine
        Its nominal modes say where spectra are narrow.
    excluded : ndarray of bool, shape (n_bins,)
        Bins that belong to no group.
    """
    spacing = frequencies_hz[1] - frequencies_hz[0]
    modes_hz, damping = natural_frequencies(machine)
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
    kernel, finer = (_KERNEL, 1) if decay > _RINGING else (_FINE_KERNEL, 2)
    reach = (kernel.size - 1) // 2
    n_nodes = finer * (max(end - first for first, end in edges) - 1) + kernel.size
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
        bins=np.array([end - first for first, end in edges], dtype=np.float64),
        centre_hz=np.array([frequencies_hz[first:end].mean() for first, end in edges]),
        nodes_hz=nodes_hz,
        weights=weights,
        shared=_shared_scatter(edges, frequencies_hz.size),
    )


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
    width = np.array([end - first for first, end in edges])
    return shared / np.sqrt(np.outer(width, width))
