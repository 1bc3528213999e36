"""The likelihood of a sliding window and of its latest, shorter stretches, hop after hop."""

from collections.abc import Mapping

import numpy as np

from models.checkpoint import checked, prefixed, unprefixed
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.readings import Diagnosis
from models.diagnosis.window import WindowStatistics
from models.machine import Machine

__all__ = ["LengthFits"]


class LengthFits:
    """One fit for the window, and one for every shorter length that has news."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._window = LikelihoodFit(machine, follow=True)
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
        """Go on where `checkpoint` was called: the next readings are the same to the last bit.

        Parameters
        ----------
        arrays : mapping of str to ndarray

        Raises
        ------
        CheckpointError
            If they are not those of this machine; nothing is changed then.
        """
        hop = int(checked(arrays, "hop", np.int64, ()))
        searched = dict(checked(arrays, "searched", np.int64, (None, 2)).tolist())
        window = LikelihoodFit(self._machine, follow=True)
        window.restore(unprefixed("window", arrays))
        short = {hops: LikelihoodFit(self._machine) for hops in searched}
        for hops, fit in short.items():
            fit.restore(unprefixed(f"short_{hops}", arrays))
        self._hop, self._searched, self._window, self._short = hop, searched, window, short

    def window(self, window: WindowStatistics) -> Diagnosis:
        """Estimate the parameters of the window at the next hop.

        Raises
        ------
        EstimationError
            As `LikelihoodFit.diagnose`.
        """
        self._hop += 1
        return self._window.diagnose(window)

    def short(self, hops: int, stretch: WindowStatistics) -> Diagnosis:
        """Estimate the parameters of the window's latest hops: at a glance if they say what the window says.

        Raises
        ------
        EstimationError
            As `LikelihoodFit.diagnose`.
        """
        seen = self._window.glance(stretch)
        if seen is not None:
            return seen
        fit = self._short.setdefault(hops, LikelihoodFit(self._machine))
        if self._searched.get(hops) != self._hop - 1:
            fit.start_near(self._window)
        self._searched[hops] = self._hop
        return fit.diagnose(stretch)
