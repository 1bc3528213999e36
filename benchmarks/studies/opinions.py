"""What the diagnosticians say of one window, as columns of a record."""

from time import process_time

import numpy as np

from benchmarks.studies.results import Value
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.relation import RelationDiagnostician
from models.diagnosis.readings import Diagnostician
from models.diagnosis.verdict.isolation import isolate_window
from models.diagnosis.window import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine

__all__ = ["RATES", "TITLES", "changed_in", "diagnosticians", "opinion"]

RATES = (0.01, 0.001)
"""Declared false alarms per window at which an opinion is judged, strict last."""

TITLES = {
    "likelihood": "likelihood",
    "network": "amortised networks",
    "relation": "equations' networks",
    "paper": "networks as printed",
}


def diagnosticians(machine: Machine, bundle: Bundle | None) -> tuple[Diagnostician, ...]:
    """The equations' networks and the amortised networks where there are some, and the likelihood, all cold."""
    likelihood = LikelihoodFit(machine)
    if bundle is None:
        return (likelihood,)
    relation = RelationDiagnostician(machine, bundle.networks)
    if bundle.amortised is None:
        return relation, likelihood
    return relation, NetworkDiagnostician(machine, bundle.amortised), likelihood


def opinion(one: Diagnostician, window: WindowStatistics, rates: tuple[float, ...] = RATES) -> dict[str, Value]:
    """Columns of a record: a refused window is a result, and counted.

    Of every parameter that is read its relative change and, with ``error`` behind its name, the standard error;
    ``named`` the parameters said to have changed, with spaces between them, and ``outside``, at the first of `rates`,
    with ``strict`` before them at the second one.
    """
    started = process_time()
    try:
        diagnosis = one.diagnose(window)
        spent, refused = process_time() - started, "; ".join(sorted({read.reason for read in diagnosis.parameters}))
    except (EstimationError, np.linalg.LinAlgError) as error:
        return {"method": one.by, "refused": str(error), "seconds": round(process_time() - started, 5)}
    if not diagnosis.evaluable:
        return {"method": one.by, "refused": refused or "nothing was read", "seconds": round(spent, 5)}
    said: dict[str, Value] = {"method": one.by, "refused": "", "seconds": round(spent, 5)}
    for read in diagnosis.evaluable:
        said |= {read.name: _rounded(read.change), f"{read.name} error": _rounded(read.standard_error)}
    for prefix, rate in zip(("", "strict "), rates, strict=False):
        verdict = isolate_window(diagnosis, rate)
        said |= {f"{prefix}named": " ".join(verdict.changed), f"{prefix}outside": verdict.outside}
    misfit = None if diagnosis.misfit_z is None else round(diagnosis.misfit_z, 3)
    return said | {"misfit": misfit, "suspect": diagnosis.suspect}


def _rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")


def changed_in(faults: dict[str, float]) -> str:
    """True changes in words."""
    return ", ".join(f"{name} {change:+.0%}" for name, change in faults.items()) or "healthy"
