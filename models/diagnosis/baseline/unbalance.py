"""The unbalance from the rotation-synchronous vectors, by means of the relation learned on the stochastic part.

With the phase reference as reference channel the stochastic force averages out of the relation. Its residual for the
synchronous vectors is the unbalance force over the stiffness to ground, F = Y1 + jΩ(c/k) Y1 - Ω²(m2/k) Y2 - …, in each
plane. Changes of the bearing enter with their own readings, so that their effect on the 1x amplitude is not taken for
unbalance. Velocities and accelerations are displacements times jΩ and -Ω².
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from pydantic import Field, FiniteFloat

from models.diagnosis.baseline.numbers import Covariance, Vector
from models.diagnosis.baseline.rows import Row, lowest, state_of
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.signals.block import ComplexArray, FloatArray

SPEED_TOLERANCE = 0.03  # relative deviation of the speed within which synchronous vectors are compared
_NEIGHBOURS = (2, 8)


@dataclass(frozen=True, slots=True, eq=False)
class SynchronousVectors:
    """Synchronous vectors of one window, or of a baseline at one speed."""

    coordinates: Annotated[tuple[str, ...], Field(min_length=1)]  # for example y1, y2, z1, z2
    vectors: Vector  # (2 n,), real parts of the displacements, then their imaginary parts, m
    covariance: Covariance  # (2 n, 2 n), from the stochastic part near the speed
    speed_rad_s: FiniteFloat
    # Whether angles are relative to the phase reference; otherwise only angles between coordinates are meaningful.
    absolute: bool = True

    def of(self, coordinates: tuple[str, ...]) -> "SynchronousVectors":
        """The vectors of some of the coordinates."""
        n = len(self.coordinates)
        keep = [self.coordinates.index(name) for name in coordinates]
        keep = [*keep, *(n + number for number in keep)]
        covariance = self.covariance[np.ix_(keep, keep)]
        return replace(self, coordinates=coordinates, vectors=self.vectors[keep], covariance=covariance)

    @property
    def largest(self) -> str:
        """Coordinate of the largest displacement."""
        n = len(self.coordinates)
        return self.coordinates[int(np.argmax(np.hypot(self.vectors[:n], self.vectors[n:])))]

    def turned(self, coordinate: str) -> "SynchronousVectors":
        """The vectors with angles relative to that of a coordinate."""
        n, at = len(self.coordinates), self.coordinates.index(coordinate)
        angle = np.arctan2(self.vectors[n + at], self.vectors[at])
        c, s = np.cos(angle) * np.eye(n), np.sin(angle) * np.eye(n)
        turn = np.block([[c, s], [-s, c]])
        return replace(self, vectors=turn @ self.vectors, covariance=turn @ self.covariance @ turn.T, absolute=False)


@dataclass(frozen=True, slots=True, eq=False)
class ForceRow:
    """A row from which the unbalance is read, and the slices of its numbers among those of all rows."""

    row: Row  # learned on the stochastic part
    coefficients: slice  # of its relation among all coefficients
    own: slice  # of its parameters among all changes


@dataclass(frozen=True, slots=True, eq=False)
class RelativeForce:
    """Unbalance force over the healthy one, less one, and its derivatives; real parts of all rows, then imaginary."""

    value: FloatArray  # (2 n_rows,)
    to_coefficients: FloatArray  # (2 n_rows, n_coefficients), with respect to all relations' coefficients
    to_change: FloatArray  # (2 n_rows, n_own), with respect to the changes of all own parameters
    # (2 n_rows, 2 n_coordinates): with respect to the real parts of the synchronous vectors, then the imaginary parts
    to_now: FloatArray
    to_healthy: FloatArray


def rotation_of(
    window: WindowStatistics, coordinates: tuple[str, ...], relations: Sequence[tuple[Row, FloatArray]]
) -> SynchronousVectors | None:
    """Synchronous vectors of a window with their covariance; None without a coordinate or a steady speed.

    If the speed was estimated from the vibration, angles relative to the shaft are not known.

    The errors are those of the forces: what the frequencies beside the speed leave in a relation, each at its own
    frequency, is nearly the same as at the speed, however near a resonance is. `relations` are rows with the
    combination of their terms, shape (n_terms,), that is left.
    """
    measured = _synchronous(window)
    if measured is None or not coordinates or not np.isfinite(window.speed_rad_s) or window.speed_rad_s == 0:
        return None
    slowest, fastest = window.speed_range
    known = [order for name in coordinates if (order := lowest(name, window.states)) is not None]
    if fastest - slowest > SPEED_TOLERANCE * window.speed_rad_s or len(known) < len(coordinates):
        return None
    columns = [window.states.index(state_of(name, order)) for name, order in zip(coordinates, known, strict=True)]
    to_displacement = (1j * window.speed_rad_s) ** -np.array(known, dtype=np.float64)
    q = measured[columns] * to_displacement
    step_hz = window.frequencies_hz[1] - window.frequencies_hz[0]
    distance = np.abs(np.round((window.frequencies_hz - window.speed_rad_s / (2 * np.pi)) / step_hz))
    # removing the synchronous part has emptied the bin of the line itself
    near = (distance >= _NEIGHBOURS[0]) & (distance <= _NEIGHBOURS[1])
    if not np.any(near):
        return None
    w = 2 * np.pi * window.frequencies_hz[near]
    at_speed, beside = (_left(relations, coordinates, speed) for speed in (np.array(window.speed_rad_s), w))
    seen = np.eye(len(columns)) + np.linalg.pinv(at_speed) @ (beside - at_speed)
    seen = seen * ((1j * w[:, None]) ** -np.array(known, dtype=np.float64))[:, None, :]
    density = seen @ window.spectrum[near][:, columns][:, :, columns] @ seen.conj().swapaxes(1, 2)
    density = density.mean(axis=0) * (2 / window.duration_s)
    # q = a - jb with the phase of cos θ, so its density is that of the Fourier transform
    covariance = np.block([[density.real, -density.imag], [density.imag, density.real]])
    absolute = window.synchronous is not None
    return SynchronousVectors(coordinates, np.concatenate([q.real, q.imag]), covariance, window.speed_rad_s, absolute)


def _synchronous(window: WindowStatistics) -> ComplexArray | None:
    """Synchronous part of the states; its angles are relative if the speed is estimated."""
    if window.synchronous is not None or window.relative_synchronous is None:
        return window.synchronous
    seen = window.relative_synchronous[np.any(window.relative_synchronous != 0, axis=1)]
    return np.asarray(seen.mean(axis=0), dtype=np.complex128) if seen.size else None


def rotations_by_speed(found: Sequence[SynchronousVectors]) -> tuple[SynchronousVectors, ...]:
    """Mean vectors for each distinct speed, slowest first; speeds within 3 % of a group's slowest are one group."""
    if not all(one.absolute for one in found):
        reference = found[0].largest
        found = [one.turned(reference) for one in found]
    groups: list[list[SynchronousVectors]] = []
    for one in sorted(found, key=lambda one: one.speed_rad_s):
        if groups and one.speed_rad_s / groups[-1][0].speed_rad_s - 1 <= SPEED_TOLERANCE:
            groups[-1].append(one)
        else:
            groups.append([one])
    return tuple(
        replace(
            near[0],
            vectors=np.mean([one.vectors for one in near], axis=0),
            covariance=np.sum([one.covariance for one in near], axis=0) / len(near) ** 2,
            speed_rad_s=float(np.mean([one.speed_rad_s for one in near])),
        )
        for near in groups
    )


def relative_force(
    rows: Sequence[ForceRow],
    coefficients: FloatArray,
    change: FloatArray,
    now: SynchronousVectors,
    healthy: SynchronousVectors,
) -> RelativeForce:
    """Ratio of the rows' residuals for the present synchronous vectors to those for the healthy ones.

    `coefficients`, shape (n_coefficients,), are those of all relations; `change`, shape (n_own,), is the relative
    change of all their own parameters since the machine was healthy.
    """
    n, n_coordinates = len(rows), len(now.coordinates)
    ratio = np.zeros(n, dtype=np.complex128)
    to_coefficients, to_change, to_now, to_healthy = (
        np.zeros((n, size), dtype=np.complex128)
        for size in (coefficients.size, change.size, 2 * n_coordinates, 2 * n_coordinates)
    )
    for number, one in enumerate(rows):
        combination = np.concatenate([[1.0], -coefficients[one.coefficients]])
        factors = np.ones((len(one.row.own), combination.size))
        for factor, own, value in zip(factors, one.row.own, change[one.own], strict=True):
            factor[list(own.terms)] = 1 + value
        terms, before = (_terms(one.row, at.coordinates, np.array(at.speed_rad_s)) for at in (now, healthy))
        moved, moved_before = terms @ _phasors(now), before @ _phasors(healthy)
        per_force = (healthy.speed_rad_s / now.speed_rad_s) ** 2 / (combination @ moved_before)
        scaled = combination * factors.prod(axis=0)
        ratio[number] = per_force * (scaled @ moved)
        lost = ratio[number] / (combination @ moved_before)
        to_coefficients[number, one.coefficients] = (lost * moved_before - per_force * factors.prod(axis=0) * moved)[1:]
        to_change[number, one.own] = [
            per_force * (combination * np.delete(factors, at, axis=0).prod(axis=0) * moved)[list(own.terms)].sum()
            for at, own in enumerate(one.row.own)
        ]
        to_now[number] = np.kron([1, 1j], per_force * (scaled @ terms))
        to_healthy[number] = np.kron([1, 1j], -lost * (combination @ before))
    parts = (ratio - 1, to_coefficients, to_change, to_now, to_healthy)
    return RelativeForce(*(np.concatenate([part.real, part.imag]) for part in parts))


def _phasors(vectors: SynchronousVectors) -> ComplexArray:
    n = len(vectors.coordinates)
    return np.asarray(vectors.vectors[:n] + 1j * vectors.vectors[n:], dtype=np.complex128)


def _left(
    relations: Sequence[tuple[Row, FloatArray]], coordinates: tuple[str, ...], speed_rad_s: FloatArray
) -> ComplexArray:
    """What displacements leave in relations, shape (*speed.shape, n_relations, n_coordinates)."""
    return np.stack([combination @ _terms(row, coordinates, speed_rad_s) for row, combination in relations], axis=-2)


def _terms(row: Row, coordinates: tuple[str, ...], speed_rad_s: FloatArray) -> ComplexArray:
    """A row's terms as combinations of the displacements, shape (*speed.shape, n_terms, n_coordinates)."""
    terms = np.zeros((*speed_rad_s.shape, len(row.terms), len(coordinates)), dtype=np.complex128)
    for number, term in enumerate(row.terms):
        for motion in term.motions:
            at = coordinates.index(motion.coordinate)
            terms[..., number, at] += motion.factor * (1j * speed_rad_s) ** motion.order
    return terms


class ForeignRotationError(EstimationError):
    """The 1x vectors are not those that an unbalance causes."""


def combination(design: FloatArray, covariance: FloatArray) -> FloatArray:
    """Generalised least-squares weights that combine the rows' forces to the vector of the unbalance, (2, n_rows).

    The design is of shape (n_rows, 2), the covariance of the rows' errors of shape (n_rows, n_rows).

    Raises
    ------
    EstimationError
        If it has no inverse, as when signals that do not come from a rotor contain nothing but errors.
    """
    try:
        weight = np.linalg.inv(covariance)
        return np.asarray(np.linalg.solve(design.T @ weight @ design, design.T @ weight), dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise EstimationError("unbalance not determined well enough: it is smaller than its errors") from error
