"""The likelihood of a sliding window and of its latest, shorter stretches, hop after hop."""

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.readings import Diagnosis
from models.diagnosis.window import WindowStatistics
from models.machine import Machine

__all__ = ["LengthFits"]


class LengthFits:
    """One fit for the window, and one for every shorter length that has news.

    Parameters
    ----------
    machine : Machine
    """

    def __init__(self, machine: Machine) -> None:
        self._machine = machine
        self._window = LikelihoodFit(machine, follow=True)
        self._short: dict[int, LikelihoodFit] = {}
        self._searched: dict[int, int] = {}
        self._hop = 0

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

        Parameters
        ----------
        hops : int
        stretch : WindowStatistics

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
