"""The fits of a window and of its latest hops."""

from collections.abc import Mapping

import numpy as np

from models.checkpoint import checked, prefixed, unprefixed
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.likelihood.motions import integrated
from models.diagnosis.misfit import Rival
from models.diagnosis.readings import Diagnosis
from models.diagnosis.window.moments import through
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.machine import Machine


class LengthFits:
    """One fit of the window and one of each shorter length that differs from it, and a cheap test whether any does."""

    def __init__(self, machine: Machine, *, sized: bool = False) -> None:
        self._machine, self._sized = machine, sized
        self._window = LikelihoodFit(machine, follow=True, sized=sized)
        self._short: dict[int, LikelihoodFit] = {}
        self._searched: dict[int, int] = {}
        self._hop = 0

    def checkpoint(self) -> dict[str, np.ndarray]:
        """Everything that the next hops' readings depend on, as named arrays."""
        found = {
            "hop": np.array(self._hop, dtype=np.int64),
            "searched": np.array(list(self._searched.items()), dtype=np.int64).reshape(-1, 2),
            **prefixed("window", self._window.checkpoint()),
        }
        for hops, fit in self._short.items():
            found |= prefixed(f"short_{hops}", fit.checkpoint())
        return found

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Continue where `checkpoint` was called, with the same bits; what raises has changed nothing."""
        hop = int(checked(arrays, "hop", np.int64, ()))
        searched = dict(checked(arrays, "searched", np.int64, (None, 2)).tolist())
        window = LikelihoodFit(self._machine, follow=True, sized=self._sized)
        window.restore(unprefixed("window", arrays))
        short = {hops: LikelihoodFit(self._machine, sized=self._sized) for hops in searched}
        for hops, fit in short.items():
            fit.restore(unprefixed(f"short_{hops}", arrays))
        self._hop, self._searched, self._window, self._short = hop, searched, window, short

    def window(self, window: WindowStatistics) -> Diagnosis:
        """Estimate the parameters of the window at the next hop; raises as `LikelihoodFit.diagnose`."""
        self._hop += 1
        return self._window.diagnose(window)

    def rivals(self, *, wanted: bool) -> tuple[Rival, ...]:
        """Causes outside the model that the latest window might show, see `LikelihoodFit.rivals`."""
        for fit in self._short.values():
            fit.rivals(wanted=False)
        return self._window.rivals(wanted=wanted)

    def apart(self, window: WindowStatistics) -> Diagnosis:
        """Estimate the parameters of another window from where the last one ended; the next windows ignore it."""
        fit = LikelihoodFit(self._machine, sized=self._sized)
        fit.start_near(self._window, anew=True)
        return fit.diagnose(window)

    def has_news(self, sliding: SlidingWindow, window: WindowStatistics, lengths: tuple[int, ...]) -> bool:
        """Whether the newest hops, at any of these lengths, may differ from the window or from the nominal machine.

        `window` is the latest of `sliding`. Its synchronous part is removed from the hops instead of their own: this is
        cheaper and hardly changes the spectrum away from the rotation. Always true if no single synchronous part holds
        for all hops, if accelerations are measured, or if some sensors are left out of the window.
        """
        rotation, by_hop, plan = window.as_mounted.synchronous, window.hop_synchronous, sliding.plan
        if window.states != plan.states or integrated(window) is not window:
            return True
        if rotation is None or by_hop is None or window.removed_by_hop:
            return True
        n, hops = len(plan.states), sliding.hops[-max(lengths, default=1) :]
        segments = np.concatenate([hop.segments.swapaxes(0, 1) for hop in hops], axis=1, dtype=np.complex128)
        if plan.equaliser is not None:  # back to the sensors' output
            rotation = rotation * plan.equaliser.response(np.array(window.speed_rad_s / (2 * np.pi)))
        remove, each = np.column_stack([np.eye(n), np.zeros(n), -rotation.real, rotation.imag]), len(hops[0].segments)
        by_bin = through(remove, segments)
        if plan.equaliser is not None:
            by_bin /= plan.equaliser.response(plan.frequencies_hz)[:, np.newaxis]
        by_bin = by_bin if plan.turn is None else through(plan.turn, by_bin)
        return any(
            self._window.may_be_news(by_bin[:, -length * each :], by_hop[-length:].mean(axis=0)) for length in lengths
        )

    def short(self, hops: int, stretch: WindowStatistics, *, closely: bool = False) -> Diagnosis:
        """Estimate the parameters of the window's newest hops, by `LikelihoodFit.glance` if they agree with the window.

        If `closely`, they are always searched: a glance does not tell whether the stretch is outside the model. Raises
        as `LikelihoodFit.diagnose`.
        """
        seen = None if closely else self._window.glance(stretch)
        if seen is not None:
            return seen
        fit = self._short.setdefault(hops, LikelihoodFit(self._machine, sized=self._sized))
        latest = [length for length, hop in self._searched.items() if hop == self._hop - 1]
        # After a change the window mixes two machines: a shorter stretch since then ended nearer to the new one.
        nearest = max((length for length in latest if length < hops), default=None)
        fit.start_near(self._window if nearest is None else self._short[nearest], anew=hops not in latest)
        self._searched[hops] = self._hop
        return fit.diagnose(stretch)
