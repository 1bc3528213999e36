"""The diagnosticians of a machine side by side, and what each of them names in one window."""

from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.relation import RelationDiagnostician
from models.diagnosis.readings import Diagnosis, Diagnostician
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine

__all__ = ["diagnosticians", "named_parameters", "opinion_of"]


def diagnosticians(machine: Machine, bundle: Bundle) -> tuple[Diagnostician, ...]:
    """The equations' networks, the amortised networks where the bundle has them, and the likelihood, all cold."""
    relation = RelationDiagnostician(machine, bundle.networks)
    likelihood = LikelihoodFit(machine)
    if bundle.amortised is None:
        return relation, likelihood
    return relation, NetworkDiagnostician(machine, bundle.amortised), likelihood


def opinion_of(one: Diagnostician, window: WindowStatistics) -> Diagnosis | None:
    """A diagnostician's opinion of a window; None where it refuses it: a refused window is a result, and counted."""
    try:
        return one.diagnose(window)
    except EstimationError:
        return None


def named_parameters(opinion: Diagnosis | None, false_alarm_rate: float) -> tuple[str, ...] | None:
    """Parameters that an opinion says have changed, at a declared rate per window; None if it has no reading at all."""
    if opinion is None or not opinion.evaluable:
        return None
    return isolate_window(opinion, false_alarm_rate).changed
