"""Physical parameters by maximum likelihood from a window's cross-spectra (Whittle), with their standard errors.

References
----------
P. Whittle, "Estimation and information in stationary time series", Arkiv för Matematik 2 (1953). Equation numbers are
the paper's: the theory compared with is Eqs. (1)-(12) and (17)-(18).
"""

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import partial

import numpy as np

from models.checkpoint import checked, prefixed, texts, unprefixed
from models.diagnosis.likelihood.dispersion import dispersion_of
from models.diagnosis.likelihood.following import Linearised
from models.diagnosis.likelihood.goodness import MOST_MISFIT, goodness_of_fit, unexplained_at, unseen
from models.diagnosis.likelihood.motions import BinGroups, Motions, group_bins, integrated
from models.diagnosis.likelihood.rivals import rivals_at
from models.diagnosis.likelihood.scoring import FisherScoring, Maximum, Weights, Whitened
from models.diagnosis.likelihood.spectral_model import (
    CORNERS,
    STRUCTURAL,
    Expected,
    SpectralModel,
    Speeds,
    grouped,
    starting_point,
    usual_force,
)
from models.diagnosis.likelihood.unbalance import Unbalance, estimate_unbalance, estimate_unbalance_by_hop
from models.diagnosis.misfit import Rival
from models.diagnosis.readings import Diagnosis, no_reading, parameter_reading
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import CheckpointError, EstimationError, UnexplainedError
from models.machine import Machine
from models.physics.rotor import STATE_INDEX
from models.signals.block import BoolArray, ComplexArray, FloatArray

_COLD_STEPS, _WARM_STEPS = 100, 15
_NEAR, _GAIN = 0.15, 3.0  # converged: no diagnosed parameter would move by more than this many standard errors
# A cold search first finds the region of the maximum on groups three times as wide.
_COARSE, _COARSE_STEPS, _COARSE_NEAR, _COARSE_GAIN = 3.0, 25, 1.0, 30.0
_GROUPS = 150  # width of the band over that of the widest group
# Steps after which a cold search is given up if it still exceeds the limits of evaluation by this factor. In windows
# that the theory explains, most searches have ended by then.
_PATIENCE, _HOPELESS = 30, 2.0
_OUTSIDE = "a sensor is at fault, or something outside the model has changed"
_STIFFEST, _SURELY = 0.5, 3.0  # no shaft becomes stiffer by half; standard errors by which it must read stiffer
_SYNCHRONOUS_BINS, _FEWEST_BINS = 3, 20
# Standard errors by which the newest hops may differ from the window in e, and from nominal in all parameters together.
_DIFFERS, _STANDS_OUT = 3.0, 4.0  # a change is named from five on
_LINE_ERROR = 0.01  # least relative error of e if the angle is that of a line found in the vibration
# Standard deviation of the hops' speeds, relative, above which the theory is averaged over two speeds. With one source
# and sensor noise of 0.3 %, the mean speed alone fits at 0.16 % and misfits by 7 standard errors at 0.32 %.
_WANDERS = 0.002
_MISFITS = 4  # windows in a row that misfit before one is searched cold as well, and the better maximum kept
_DOUBTFUL = 2.0  # misfit after a cold search from which another is made, with a noise of more corners
_FOLLOWED = 12  # windows in a row that may reuse one window's units and slopes before a search makes new ones

_Band = tuple[FloatArray, BoolArray]
"""Frequencies of a window's bins, and which of them are excluded."""


class LikelihoodFit:
    """Fits window after window, each from where the last one ended.

    The state kept between windows is the starting point, the strengths of the pulls on the forces' colours, and, if
    `follow`, the slopes of the last search, with which windows that differ little are followed without a new search.
    Consecutive windows must overlap for that. If `sized`, the size of e is read without a phase reference, too.
    """

    by = "likelihood"

    def __init__(self, machine: Machine, *, follow: bool = False, sized: bool = False) -> None:
        self._machine = machine
        self._sized = sized
        self._usual_cutoff_hz = math.sqrt(machine.condition.cutoff_hz[0] * machine.condition.cutoff_hz[1])
        self._follow = follow
        self._last: FloatArray | None = None
        self._strengths: FloatArray | None = None
        self._line: Linearised | None = None
        self._line_segments = self._followed = self._misfits = 0
        self._corners = 1  # of the sensor noise's colour
        self._line_band: _Band | None = None
        self._latest: tuple[SpectralModel, Expected, FloatArray, float] | None = None
        self._said: tuple[Diagnosis, Unbalance, ComplexArray] | None = None  # with the window's synchronous vector
        self._rivals: Callable[[], tuple[Rival, ...]] = tuple  # of the window diagnosed last: megabytes
        self._groups: dict[bytes, BinGroups] = {}

    def reset(self) -> None:
        """Start the next window cold."""
        self._last = self._strengths = self._line = None
        self._misfits = 0

    def start_near(self, other: "LikelihoodFit", *, anew: bool) -> None:
        """Start the next window where another fit of the same machine has ended: `anew`, or if the noise is another."""
        if anew or self._corners != other._corners:
            self._last, self._strengths, self._line = other._last, other._strengths, None
            self._corners, self._followed, self._misfits = other._corners, 1, 0  # as if it had been followed there

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything that the next windows' readings depend on, as named arrays."""
        found: dict[str, np.ndarray] = {
            "last": np.array([] if self._last is None else self._last, dtype=np.float64),
            "strengths": np.full(2, np.nan) if self._strengths is None else self._strengths,
            "followed": np.array([self._line_segments, self._followed, self._misfits, self._corners], dtype=np.int64),
        }
        line = self._line
        if line is not None and self._line_band is not None:
            frequencies_hz, excluded = self._line_band
            found |= prefixed("line", line.checkpoint())
            found |= {
                "states": np.array(line.model.motions.states, dtype=np.str_),
                "scale": line.model.motions.scale,
                "force_scale": np.array(line.model.force_unit[0], dtype=np.float64),
                "line_strengths": line.weights.strengths,
                "frequencies_hz": frequencies_hz,
                "excluded": excluded,
            }
        return found

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue where `checkpoint` was called, with the same bits; what raises has changed nothing."""
        last = checked(arrays, "last", np.float64, (None,))
        strengths = checked(arrays, "strengths", np.float64, (2,))
        segments, followed, misfits, corners = checked(arrays, "followed", np.int64, (4,)).tolist()
        line = band = None
        if "states" in arrays:
            frequencies_hz = checked(arrays, "frequencies_hz", np.float64, (None,))
            band = frequencies_hz, checked(arrays, "excluded", np.bool_, frequencies_hz.shape)
            try:
                with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                    line = self._restored_line(arrays, segments, band, corners)
            except np.linalg.LinAlgError as error:
                raise CheckpointError(f"{self._machine.name}: the remembered maximum makes no valid spectra") from error
        self._last = last if last.size else None
        self._strengths = strengths if np.all(np.isfinite(strengths)) else None
        self._line, self._line_band, self._line_segments = line, band, segments
        self._followed, self._misfits, self._corners = followed, misfits, corners

    def _restored_line(self, arrays: Mapping[str, np.ndarray], segments: int, band: _Band, corners: int) -> Linearised:
        states, (frequencies_hz, excluded) = texts(arrays, "states"), band
        if not STATE_INDEX.keys() >= set(states) or frequencies_hz.size < 2 or excluded.all():
            raise CheckpointError(
                f"{self._machine.name}: the remembered maximum is that of states {', '.join(states)} at "
                f"{frequencies_hz.size} frequencies, {np.count_nonzero(excluded)} of them excluded"
            )
        motions = Motions(states, checked(arrays, "scale", np.float64, (len(states),)))
        force_scale = float(checked(arrays, "force_scale", np.float64, ()))
        line = unprefixed("line", arrays)
        speeds = 2 if checked(line, "speeds_rad_s", np.float64, (None,)).size > 3 else 1
        groups = self._grouped(band, speeds)
        model = SpectralModel(self._machine, motions, groups, force_scale, corners=corners)
        strengths = checked(arrays, "line_strengths", np.float64, (2,))
        return Linearised.restored(model, Weights(model, segments, self._usual_cutoff_hz, strengths), line)

    def diagnose(self, window: WindowStatistics) -> Diagnosis:
        """Estimate the parameters of one window.

        Raises
        ------
        EstimationError
            If a channel has no power in the band (a dead sensor), or two carry the same signal.
        UnexplainedError
            If the search finds no maximum, or nothing within the model comes near the window.
        """
        window, afresh, first = integrated(window), self._last is None, self._latest is None
        self._rivals = tuple
        followed = self._followed > 0
        found = self._searched(window)
        again = self._misfits > 0 and self._misfits % _MISFITS == 0
        # Perhaps all have ended at a wrong maximum; or the first has: where following ended need be near no force.
        if (again or (followed and self._misfits == 1)) and not afresh:
            found = self._retried(window, found, self._corners, found.misfit_z or 0.0)
        if afresh and (found.misfit_z or 0.0) > _DOUBTFUL and self._latest is not None:
            # With the forces that it has found there may be a better maximum near the nominal rotor.
            nominal = np.concatenate([np.zeros(len(STRUCTURAL)), self._latest[1].theta[len(STRUCTURAL) :]])
            found = self._retried(window, found, self._corners, found.misfit_z or 0.0, nominal)
        misfit_z = found.misfit_z or 0.0
        if self._corners < CORNERS and (again or afresh) and misfit_z > _DOUBTFUL and (first or not found.unexplained):
            # Perhaps the noise has a colour of more than one corner.
            found = self._retried(window, found, CORNERS, min(misfit_z, MOST_MISFIT))
        return found

    def _retried(
        self, window: WindowStatistics, found: Diagnosis, corners: int, misfit_z: float, start: FloatArray | None = None
    ) -> Diagnosis:
        """Return and keep what a search, cold or from `start`, finds with less than `misfit_z`, otherwise `found`."""
        cold = copy(self)
        cold.reset()
        cold._last, cold._corners = start, corners
        with suppress(EstimationError):
            other = cold._searched(window)
            if not other.unexplained and (other.misfit_z or 0.0) < misfit_z:
                vars(self).update(vars(cold))
                return other
        return found

    def _searched(self, window: WindowStatistics) -> Diagnosis:
        speed, speeds = self._speed(window), self._speeds(window)
        band = window.frequencies_hz, _near_lines(window, speed)
        scale = np.sqrt(self._checked_power(window, ~band[1]))
        states = grouped(self._machine, window, self._grouped(band, _count(speeds)))
        try:
            # Trial points may lie far out; their results are checked, so no warnings are needed.
            with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
                model, weights, found = self._followed_or_searched(window, band, scale, speeds, states)
            known = np.linalg.inv(found.information) if found.covariance is None else found.covariance
            covariance: FloatArray = np.asarray(known, dtype=np.float64)
            if not (np.all(np.isfinite(found.theta)) and np.all(np.diag(covariance) > 0)):
                raise np.linalg.LinAlgError("no maximum")
        except np.linalg.LinAlgError as error:
            self.reset()
            raise UnexplainedError(
                f"{self._machine.name}: the likelihood has no maximum for this window: {_OUTSIDE}"
            ) from error
        self._last, self._strengths = found.theta, weights.strengths
        dispersion = dispersion_of(model, weights, found, window.segments)
        why, nowhere = unexplained_at(model, weights, found.whitened, states, dispersion=dispersion)
        unexplained = self._stated(why)
        if nowhere:
            raise UnexplainedError(unexplained)
        goodness = goodness_of_fit(model, weights, found, states, dispersion)
        self._misfits = self._misfits + 1 if goodness.misfit_z > MOST_MISFIT else 0
        if not unexplained and goodness.misfit_z > MOST_MISFIT:
            unexplained = self._stated(unseen(model, weights, found, goodness.misfit_z))
        n = len(STRUCTURAL)
        # A search that has not converged adds the step it would still take to the uncertainty.
        structural = covariance[:n, :n] + np.diag(found.remaining**2)
        self._latest = model, found.whitened.point.expected, structural, speed
        read, unbalance = self._read(window, *self._latest)
        usual = window.synchronous
        self._said = None if unbalance is None or usual is None else (read, unbalance, usual)
        unexplained = unexplained or self._too_stiff(read)
        at = weights, found, structural, speed, window.duration_s, read.unbalance
        self._rivals = partial(rivals_at, model, *at)
        return replace(
            read,
            misfit_z=goodness.misfit_z,
            goodness=goodness,
            suspect=goodness.suspected(unexplained=bool(unexplained)),
            unexplained=unexplained,
            steps=found.steps,
        )

    def balanced(self, machine: Machine, window: WindowStatistics, diagnosis: Diagnosis) -> Diagnosis:
        """Read the window that was diagnosed last relative to a machine that differs in its unbalance alone.

        The stochastic part does not depend on the unbalance, so no new search is needed.
        """
        if self._latest is None:
            raise EstimationError(f"{machine.name}: no window has been diagnosed")
        self._machine = machine
        read, _ = self._read(integrated(window), *self._latest)
        return replace(diagnosis, parameters=read.parameters, covariance=read.covariance, unbalance=read.unbalance)

    def rivals(self, *, wanted: bool) -> tuple[Rival, ...]:
        """Causes outside the model that the window diagnosed last might show; once, and none unless `wanted`."""
        rivals, self._rivals = self._rivals, tuple
        with suppress(np.linalg.LinAlgError):
            return rivals() if wanted else ()
        return ()

    def glance(self, stretch: WindowStatistics) -> Diagnosis | None:
        """Read the newest hops of the window diagnosed last by one step from the window's maximum.

        None if there is no such window or the stretch differs from it: `diagnose` the stretch then. Whether it is
        outside the model is not tested closely, so there is no misfit.
        """
        stretch = integrated(stretch)
        line, speed = self._line, self._speed(stretch)
        if line is None:
            return None
        groups = self._grouped((stretch.frequencies_hz, _near_lines(stretch, speed)), line.model.groups.speeds)
        if not groups.same_as(line.model.groups) or stretch.states != line.model.motions.states:
            return None
        seen = line.glance(_observed(line.model, stretch), stretch.n_segments / self._line_segments)
        if seen is None:
            return None
        try:
            return self._read(stretch, line.model, *seen, speed)[0]
        except EstimationError:
            return None

    def may_be_news(self, segments: ComplexArray, synchronous: ComplexArray) -> bool:
        """Whether the newest hops may differ from the latest window or from the nominal machine.

        They are given by Fourier coefficients without the rotation, shape (n_bins, n_segments, n_states), and by their
        synchronous vector, shape (n_states,).
        """
        line = self._line
        if line is None or self._said is None:
            return True
        read, unbalance, usual = self._said
        model, share, vector = line.model, segments.shape[1] / self._line_segments, unbalance.vector
        seen = line.glance(model.observed(model.groups.cross_spectra(segments)), share)
        moved = complex(unbalance.weights @ (synchronous - usual))
        differs = max(moved.real**2 / vector.variance_real, moved.imag**2 / vector.variance_imaginary)
        if seen is None or not share * differs <= _DIFFERS**2:
            return True
        values = np.append(np.expm1(seen[0].theta[: len(STRUCTURAL)]), unbalance.change + moved.real)
        stands_out = values @ np.linalg.solve(read.full_covariance, values)
        stands_out += (vector.imaginary + moved.imag) ** 2 / vector.variance_imaginary
        return not share * stands_out <= _STANDS_OUT**2

    def _speed(self, window: WindowStatistics) -> float:
        return window.speed_rad_s if np.isfinite(window.speed_rad_s) else self._machine.operation.speed_rad_s

    def _speeds(self, window: WindowStatistics) -> Speeds:
        speed, of_hops = self._speed(window), window.hop_speed_rad_s[np.isfinite(window.hop_speed_rad_s)]
        spread = float(of_hops.std()) if of_hops.size else 0.0
        return (speed - spread, speed + spread) if spread > _WANDERS * abs(speed) else speed

    def _read(
        self, window: WindowStatistics, model: SpectralModel, point: Expected, structural: FloatArray, speed: float
    ) -> tuple[Diagnosis, Unbalance | None]:
        """Readings of the structural parameters at a point, and of e from the window's synchronous part."""
        ratio = np.exp(point.theta[: len(STRUCTURAL)])
        change, spread = ratio - 1, structural * np.outer(ratio, ratio)
        errors = np.sqrt(np.diag(spread))
        readings = [
            parameter_reading(name, self.by, float(value), float(error))
            for name, value, error in zip(STRUCTURAL, change, errors, strict=True)
        ]
        e = vector = None
        if window.synchronous is not None or (self._sized and window.relative_synchronous is not None):
            e = self._unbalance(window, model, point, structural, speed)
            vector = None if window.synchronous is None else e.vector
        if e is not None and e.vector.foreign and vector is None:
            readings.append(no_reading("e", self.by, e.vector.foreign))
        elif e is not None:
            cross = (e.covariance * ratio)[:, None]
            spread = np.block([[spread, cross], [cross.T, np.array([[e.variance]])]])
            readings.append(parameter_reading("e", self.by, e.change, math.sqrt(e.variance), vector))
        covariance = np.asarray(spread, dtype=np.float64)
        return Diagnosis(self.by, tuple(readings), covariance=covariance, unbalance=vector), e

    def _unbalance(
        self, window: WindowStatistics, model: SpectralModel, point: Expected, structural: FloatArray, speed: float
    ) -> Unbalance:
        """Change of e; hop by hop where the speed varies, or is found in the vibration, which gives no shaft angle."""
        known = (self._machine, model, point, structural)
        if window.relative_synchronous is not None:
            hop_s, found = window.duration_s / window.hop_speed_rad_s.size, np.isfinite(window.hop_speed_rad_s)
            hops = window.relative_synchronous[found], window.hop_speed_rad_s[found], hop_s
            e = estimate_unbalance_by_hop(*known, *hops, sized=True)
            return replace(e, variance=e.variance + (_LINE_ERROR * (1 + e.change)) ** 2)
        if window.removed_by_hop and window.hop_synchronous is not None:
            if not window.hop_synchronous.any(axis=1).all():
                raise EstimationError(f"{self._machine.name}: the shaft turned by less than a quarter turn in a hop")
            hop_s = window.duration_s / window.hop_speed_rad_s.size
            hops = window.hop_synchronous, window.hop_speed_rad_s, hop_s
            return estimate_unbalance_by_hop(*known, *hops, directed=window.directed)
        if window.synchronous is None:
            raise EstimationError(f"{self._machine.name}: no phase reference")
        ratios = estimate_unbalance(*known, window.synchronous, speed, window.duration_s)
        return ratios.decided(directed=window.directed)

    def _followed_or_searched(
        self, window: WindowStatistics, band: _Band, scale: FloatArray, speed: Speeds, states: ComplexArray
    ) -> tuple[SpectralModel, Weights, Maximum]:
        found = None
        line, self._line = self._line, None
        if (
            line is not None
            and self._followed < _FOLLOWED
            and window.n_segments == self._line_segments
            and window.states == line.model.motions.states
            and self._grouped(band, _count(speed)).same_as(line.model.groups)
        ):
            self._followed += 1
            found = line.follow(line.model.observed(states), speed, _NEAR, _GAIN)
            if found is not None:
                self._line = line
                return line.model, line.weights, found
            # The units stay the same, and the first step uses the derivatives where the last search ended.
            model, search = line.model, self._search(line.model, window, speed, self._strengths)
            with suppress(np.linalg.LinAlgError):  # unless that makes no valid spectrum for this window
                found = search.maximise(line.theta, _WARM_STEPS, _NEAR, _GAIN, line.derivatives)
        if found is None:
            model, search, found = self._maximise(window, band, scale, speed)
            self._followed = 0
        if self._follow:
            self._line, self._line_segments = Linearised.around(model, search.weights, found), window.n_segments
            self._line_band = band
        return model, search.weights, found

    def _checked_power(self, window: WindowStatistics, used: BoolArray) -> FloatArray:
        """Mean density of every state; raises EstimationError for dead or doubled channels."""
        if np.count_nonzero(used) < _FEWEST_BINS:
            raise EstimationError(
                f"{self._machine.name}: steady lines and the rotation leave {np.count_nonzero(used)} of the "
                f"{used.size} frequencies in band_hz, expected at least {_FEWEST_BINS}"
            )
        observed = window.spectrum[used]
        power = np.einsum("fii->i", observed).real / observed.shape[0]
        # The difference of two states with the same signal is nothing but rounding.
        cross = observed.real.mean(axis=0)
        own = np.diag(cross)[:, np.newaxis]
        for later, earlier in np.argwhere(np.tril(own + np.diag(cross) - 2 * cross < 1e-9 * own, -1)):
            twins = f"{window.states[earlier]} and {window.states[later]}"
            raise EstimationError(f"{self._machine.name}: channels {twins} carry the same signal")
        # A dead state has less than a thousandth of the amplitude of another one of its kind.
        rates = np.array([name.endswith("_dot") for name in window.states])
        largest = np.where(rates, power[rates].max(initial=0.0), power[~rates].max(initial=0.0))
        if dead := [window.states[at] for at in np.flatnonzero(~(power > 1e-6 * largest))]:
            raise EstimationError(
                f"{self._machine.name}: no fluctuation in {', '.join(dead)}: nothing to compare with theory"
            )
        return np.asarray(power, dtype=np.float64)

    def _maximise(
        self, window: WindowStatistics, band: _Band, scale: FloatArray, speed: Speeds
    ) -> tuple[SpectralModel, FisherScoring, Maximum]:
        """Search from the last window's maximum, or cold: first on coarse groups with one low-pass for all forces."""
        groups = self._grouped(band, _count(speed))
        motions = Motions(window.states, scale)
        force_scale = usual_force(self._machine, motions, groups, speed, self._usual_cutoff_hz)
        model = SpectralModel(self._machine, motions, groups, force_scale, corners=self._corners)
        search = self._search(model, window, speed, self._strengths)
        if self._last is not None and self._last.size == model.size:
            try:
                return model, search, search.maximise(self._last, _WARM_STEPS, _NEAR, _GAIN)
            except np.linalg.LinAlgError:  # the old point makes no valid spectrum for this window
                self.reset()
                search = self._search(model, window, speed)
        wide = self._grouped(band, _count(speed), _COARSE)
        coarse = SpectralModel(self._machine, motions, wide, force_scale, shapes=0, corners=self._corners)
        first = self._search(coarse, window, speed)
        start = starting_point(coarse, _observed(coarse, window), first.weights.centre, self._speed(window))
        near = first.maximise(start, _COARSE_STEPS, _COARSE_NEAR, _COARSE_GAIN).theta
        theta = search.weights.centre.copy()
        theta[: coarse.colour_at.stop], theta[model.level_at] = near[: coarse.colour_at.stop], near[coarse.level_at]
        states = grouped(self._machine, window, groups)

        def is_hopeless(steps: int, reached: Whitened) -> bool:
            return steps == _PATIENCE and bool(unexplained_at(model, search.weights, reached, states, _HOPELESS)[0])

        return model, search, search.maximise(theta, _COLD_STEPS, _NEAR, _GAIN, hopeless=is_hopeless)

    def _search(
        self, model: SpectralModel, window: WindowStatistics, speed: Speeds, strengths: FloatArray | None = None
    ) -> FisherScoring:
        observed = _observed(model, window)
        return FisherScoring(model, observed, window.n_segments, speed, self._usual_cutoff_hz, strengths)

    def _grouped(self, band: _Band, speeds: int, coarser: float = 1.0) -> BinGroups:
        """Groups for a band, remembered while the speed stays in the same bin."""
        frequencies_hz, excluded = band
        key = frequencies_hz.tobytes() + excluded.tobytes() + bytes([speeds, int(coarser)])
        if key not in self._groups:
            if len(self._groups) >= 8:
                self._groups.clear()
            low, high = self._machine.window.band_hz
            widest_hz = coarser * (high - low) / _GROUPS
            self._groups[key] = group_bins(frequencies_hz, self._machine, excluded, widest_hz, speeds)
        return self._groups[key]

    def _stated(self, why: str) -> str:
        """Why a window is unexplained, as a sentence; empty if it is explained."""
        if not why:
            return ""
        self.reset()  # perhaps the search has followed another maximum: start the next window cold
        return f"{self._machine.name}: the theory does not explain this window: {why}; {_OUTSIDE}"

    def _too_stiff(self, read: Diagnosis) -> str:
        """Why no fault of the shaft explains how stiff it reads; empty if it does not read that stiff."""
        at = STRUCTURAL.index("EI")
        change, error = read.parameters[at].relative_change, read.parameters[at].standard_error
        if change is None or error is None or change - _SURELY * error < _STIFFEST:
            return ""
        return (
            f"{self._machine.name}: it would take a shaft {100 * change:.0f} % stiffer than that of the machine file, "
            "which no fault of a shaft causes: something holds it, such as a locked coupling, or the file's masses or "
            "lengths are not those of this machine, or its shaft is not"
        )


def _count(speed: Speeds) -> int:
    return len(speed) if isinstance(speed, tuple) else 1


def _observed(model: SpectralModel, window: WindowStatistics) -> ComplexArray:
    """Estimated spectra in the model's groups and units."""
    return model.observed(grouped(model.machine, window, model.groups))


def _near_lines(window: WindowStatistics, speed_rad_s: float) -> BoolArray:
    """Bins around the rotation, over its range of speeds, and other lines: their residue is not stochastic."""
    f = window.frequencies_hz
    slowest, fastest = window.speed_range if window.removed_by_hop else (speed_rad_s, speed_rad_s)
    passed = np.clip(f, slowest / (2 * np.pi), fastest / (2 * np.pi))
    # What was found in the vibration hop by hop includes what a hop does not resolve.
    found = window.hop_speed_rad_s.size / window.duration_s if window.relative_synchronous is not None else 0.0
    return np.asarray((np.abs(f - passed) <= _SYNCHRONOUS_BINS * max(f[1] - f[0], found)) | window.line_bins)
