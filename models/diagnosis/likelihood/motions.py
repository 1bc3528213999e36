"""One motion per measured degree of freedom, from its displacement and its velocity sensor together.

A displacement x and a velocity v of the same degree of freedom are the same motion twice: v = jωx but for sensor noise.
Compared with theory side by side, what little finite segments let them differ by counts as information of its own,
which it is not: near resonances it is the neighbouring bins once more. In units in which both noises are one,

    z = (x - jr v) / √(1 + r²),    r = ω · (unit of x) / (unit of v),

is a rotation: its noise is one again, it holds everything that the pair says about the motion, and what is left,
(v - jr x) / √(1 + r²), holds noise and, if the gain of a sensor has drifted, the difference of the two gains.
"""

from dataclasses import dataclass

import numpy as np

from models.diagnosis.moments import ComplexArray
from models.physics.matrices import COORDINATES, STATE_INDEX
from models.signals.block import FloatArray

__all__ = ["Mismatch", "Motions"]

_ABSENT = -1
_GAIN_FLOOR = 0.005
"""Error of a pair's gain that no window length removes: unequal noise and leakage pass for as much."""


@dataclass(frozen=True, slots=True)
class Mismatch:
    """How far the displacement and the velocity of one degree of freedom disagree.

    Attributes
    ----------
    states : (str, str)
        Displacement and velocity.
    change : float
        Gain of the velocity relative to that of the displacement, minus one.
    z : float
        The same in standard errors.
    """

    states: tuple[str, str]
    change: float
    z: float


class Motions:
    """Measured degrees of freedom, and how the measured states make them.

    Parameters
    ----------
    states : tuple of str
        Measured states.
    scale : ndarray, shape (n_states,)
        Unit of each, in the ratio of the sensors' noise: the mean amplitude in the band, for want of better.
    """

    def __init__(self, states: tuple[str, ...], scale: FloatArray) -> None:
        self.states, self.scale = states, scale
        column = {STATE_INDEX[name]: at for at, name in enumerate(states)}
        self.dofs = np.array([dof for dof in range(6) if dof in column or dof + 6 in column])
        self._x = np.array([column.get(dof, _ABSENT) for dof in self.dofs])
        self._v = np.array([column.get(dof + 6, _ABSENT) for dof in self.dofs])
        self._has_x, self._has_v = self._x != _ABSENT, self._v != _ABSENT
        self._unit_x = np.where(self._has_x, scale[self._x], 1.0)
        self._unit_v = np.where(self._has_v, scale[self._v], 1.0)

    @property
    def n(self) -> int:
        """Number of motions."""
        return self.dofs.size

    @property
    def names(self) -> tuple[str, ...]:
        """Coordinate of every motion."""
        return tuple(COORDINATES[dof] for dof in self.dofs)

    def _r(self, w: FloatArray) -> FloatArray:
        """How many times stronger the velocity's share is, shape (…, n): 0 for a displacement alone."""
        return np.asarray(
            np.where(self._has_x & self._has_v, w[..., None] * self._unit_x / self._unit_v, 0.0), dtype=np.float64
        )

    def factor(self, w: FloatArray, centre: FloatArray) -> ComplexArray:
        """What a displacement of one, at frequency w, makes of each motion.

        Parameters
        ----------
        w : ndarray
            Angular frequencies, rad/s.
        centre : ndarray, broadcast to the shape of w
            Frequency the states are combined for: that of the group w is seen in.

        Returns
        -------
        ndarray, shape (*w.shape, n)
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

    def spectra(self, states: ComplexArray, w: FloatArray) -> ComplexArray:
        """Cross-spectra of the motions from those of the states, shape (n_groups, n, n)."""
        matrix = self.combine(w)
        return np.asarray(matrix @ states @ matrix.conj().swapaxes(-1, -2), dtype=np.complex128)

    def shares(self, w: FloatArray) -> dict[str, tuple[int, FloatArray]]:
        """Of each state: the motion it is part of, and its share in that motion's amplitude at frequencies w."""
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
        """Power of what the two sensors of a motion do not share, shape (n_groups, n); infinite where there is one.

        Parameters
        ----------
        states : ndarray, shape (n_groups, n_states, n_states)
            Cross-spectra of the states, SI.
        w : ndarray, shape (n_groups,)
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

    def mismatches(self, states: ComplexArray, w: FloatArray, averages: FloatArray) -> list[Mismatch]:
        """Compare displacement and velocity of every degree of freedom that has both.

        With gains 1 and 1 + δ the rest d = (v - jr x)/√(1 + r²) of a pair holds jr δ z/(1 + r²) of its motion z; δ is
        the least-squares regression of d on that, with standard error from what of d remains.

        Parameters
        ----------
        states : ndarray, shape (n_groups, n_states, n_states)
            Cross-spectra of the states, SI.
        w : ndarray, shape (n_groups,)
        averages : ndarray, shape (n_groups,)
            Independent averages they are made of.
        """
        found = []
        r = self._r(w)
        for at in np.flatnonzero(self._has_x & self._has_v):
            x, v = self._x[at], self._v[at]
            units = self.scale[[x, v]]
            pair = states[:, [x, v]][:, :, [x, v]] / np.outer(units, units)
            root = np.sqrt(1 + r[:, at] ** 2)
            to_z = np.stack([np.ones_like(root), -1j * r[:, at]], axis=1) / root[:, None]
            to_d = np.stack([-1j * r[:, at], np.ones_like(root)], axis=1) / root[:, None]
            regressor = 1j * r[:, at] / root**2
            zz, dz, dd = (
                np.einsum("fi,fij,fj->f", left, pair, right.conj())
                for left, right in ((to_z, to_z), (to_d, to_z), (to_d, to_d))
            )
            power = np.abs(regressor) ** 2 * zz.real
            total = averages @ power
            delta = float(averages @ (dz * regressor.conj()).real / total)
            # Group by group: leakage makes the rest largest where the motion is. Where noise is much of the motion,
            # unequal noise of the two sensors passes for a difference of gain.
            noise = averages @ (np.abs(regressor) ** 2 * dd.real) / total
            error = float(np.sqrt(averages @ (power * dd.real) / 2 / total**2 + noise**2 + _GAIN_FLOOR**2))
            found.append(Mismatch((self.states[x], self.states[v]), delta, delta / error))
        return found
