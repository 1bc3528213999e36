"""Results of the diagnosticians in one window as columns of a record, and their correctness."""

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from time import process_time

import numpy as np

from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.results import Goal, Record, Value
from models.diagnosis.likelihood.fit import LikelihoodFit
from models.diagnosis.networks.amortised import NetworkDiagnostician
from models.diagnosis.networks.bundle import Bundle, load_bundle
from models.diagnosis.networks.relation import RelationDiagnostician
from models.diagnosis.readings import Z95, Diagnostician
from models.diagnosis.verdict.calibration import widened
from models.diagnosis.verdict.isolation import isolate_window, reading_of
from models.diagnosis.verdict.stretch import Stretch, stretch_of
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import EstimationError
from models.machine import Machine, load_machine
from models.physics.rotor import PARAMETERS
from rotorwatch.records.windows import Parameter
from simulator.training.draws import Layout

RATES = (0.01, 0.001)  # declared false-alarm rates per window at which results are evaluated, the strict one last
TITLES = {
    "likelihood": "likelihood",
    "network": "amortised networks",
    "relation": "equations' networks",
    "paper": "networks as printed",
}
ONE, SEVERAL = "one source", "independent sources"
LAYOUTS = {None: "either", Layout.ONE_SOURCE: ONE, Layout.INDEPENDENT: SEVERAL}


@dataclass(frozen=True, slots=True)
class Trained:
    """A machine, and the networks trained for it, if any."""

    machine: Machine
    bundle: Bundle | None

    @classmethod
    def named(cls, name: str) -> "Trained":
        """Load a machine by shipped name or file, with the networks of its name."""
        machine = load_machine(name)
        return cls(machine, load_bundle(machine.name, machine))

    def diagnosticians(self) -> tuple[Diagnostician, ...]:
        """The relation and amortised networks, if any, and the likelihood, all without state from earlier windows."""
        likelihood = LikelihoodFit(self.machine)
        if self.bundle is None:
            return (likelihood,)
        relation = RelationDiagnostician(self.machine, self.bundle.networks)
        if self.bundle.amortised is None:
            return relation, likelihood
        return relation, NetworkDiagnostician(self.machine, self.bundle.amortised), likelihood


def physics_hash(machine: Machine) -> str:
    """Twelve hexadecimal digits that change with the rotor, its operation or condition range, rate or window."""
    fields = {"rotor", "operation", "condition", "rate_hz", "window", "schedule"}
    text = json.dumps(machine.model_dump(mode="json", include=fields), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def made_with(machines: Iterable[Trained]) -> dict[str, str]:
    """Digests of machines and bundles that all records of a study must share."""
    return {
        one.machine.name: f"{physics_hash(one.machine)} {one.bundle.identity if one.bundle else ''}" for one in machines
    }


def opinion(one: Diagnostician, window: WindowStatistics, rates: tuple[float, ...] = RATES) -> dict[str, Value]:
    """Columns of a record with a diagnostician's results; a refused window is a result too.

    For every parameter read, the relative change, and in ``<name> error`` the standard error; ``named``, the parameters
    named as changed, separated by spaces; ``largest``, the largest change among them; and ``outside``. These three are
    at the first of `rates`; those with the prefix ``strict`` at the second.
    """
    started = process_time()
    try:
        diagnosis = one.diagnose(window)
        refused = "; ".join(sorted({read.reason for read in diagnosis.parameters})) or "nothing was read"
        read = diagnosis.evaluable
    except (EstimationError, np.linalg.LinAlgError) as error:
        refused, read = str(error), ()
    seconds = round(process_time() - started, 5)
    if not read:
        return {"method": one.by, "refused": refused, "seconds": seconds}
    said: dict[str, Value] = {"method": one.by, "refused": "", "seconds": seconds}
    for parameter in read:
        figures = (parameter.relative_change or 0.0, parameter.standard_error or 0.0)
        change, error_ = (float(f"{figure:.6g}") for figure in figures)
        said |= {parameter.name: change, f"{parameter.name} error": error_}
    for prefix, rate in zip(("", "strict "), rates, strict=False):
        verdict = isolate_window(diagnosis, rate)
        stretch = stretch_of(widened(diagnosis, rate), 0, 0).complete().believed()
        named = restricted(stretch, verdict.changed, one.by)
        said |= {f"{prefix}named": " ".join(verdict.changed), f"{prefix}outside": verdict.outside}
        said[f"{prefix}largest"] = max((abs(read.relative_change or 0.0) for read in named), default=0.0)
    misfit = None if diagnosis.misfit_z is None else round(diagnosis.misfit_z, 3)
    return said | {"misfit": misfit, "suspect": diagnosis.suspect}


def restricted(stretch: Stretch, names: tuple[str, ...], by: str) -> tuple[Parameter, ...]:
    """Read some parameters with all others held at nominal; those that were not evaluable are left out."""
    chosen = [i for i in stretch.known if PARAMETERS[i] in names]
    if not chosen:
        return ()
    covariance = np.linalg.inv(stretch.information[np.ix_(chosen, chosen)])
    values = covariance @ stretch.vector[chosen]
    return tuple(
        reading_of(stretch, PARAMETERS[i], by, value, math.sqrt(variance))
        for i, value, variance in zip(chosen, values.tolist(), np.diag(covariance).tolist(), strict=True)
    )


def truth(faults: Mapping[str, float]) -> dict[str, Value]:
    """True changes as columns of a record."""
    return {f"{name} true": faults.get(name, 0.0) for name in PARAMETERS}


def named_in(record: Record, column: str = "named") -> set[str]:
    """Parameters named in a record; empty for a refused window."""
    return set(str(record.get(column) or "").split())


def judged(records: Iterable[Record]) -> Iterator[Record]:
    """Records with columns on their correctness, at the first declared rate.

    ``any``: a parameter is named; ``exact``: exactly the changed ones are named; ``wrong``: an unchanged one is named;
    ``claimed``: a parameter other than EI is named, without "outside the model"; ``noticed``: outside the model, or a
    suspect is named.
    """
    for record in records:
        named, true = named_in(record), {name for name in PARAMETERS if record.get(f"{name} true")}
        yield {
            **record,
            "any": bool(named),
            "strict any": bool(record.get("strict named")),
            "exact": not record.get("refused") and named == true,
            "wrong": not named <= true,
            "claimed": bool(named - {"EI"}) and not record.get("outside"),
            "noticed": bool(record.get("outside") or record.get("suspect")),
            "outside": bool(record.get("outside")),
        }


def readings(records: Iterable[Record]) -> Iterator[Record]:
    """One row for every parameter of every window, refused or not, with its deviation from the truth and coverage."""
    for record in records:
        for name in PARAMETERS:
            change, error, true = (record.get(f"{name}{column}") for column in ("", " error", " true"))
            row = {**record, "parameter": name, "is named": name in named_in(record), "true": true or 0.0}
            if isinstance(change, float) and isinstance(error, float):
                off, bound = change - float(true or 0.0), record.get(f"{name} bound")
                row |= {"read": change, "off": off, "off %": 100 * off, "error": error, "in errors": off / error}
                row["covered"] = abs(off) <= Z95 * error
                row |= {"bound": bound, "in bounds": off / float(bound)} if bound else {}
            yield row


def changed_in(faults: Mapping[str, float]) -> str:
    """True changes in words."""
    return ", ".join(f"{name} {change:+.0%}" for name, change in faults.items()) or "healthy"


BIAS = r.estimated("in errors", lambda x: np.asarray(np.mean(x, axis=-1)), 2)
READING_COLUMNS: dict[str, r.Of[r.Figure]] = {
    "read": lambda rows: sum("off" in row for row in rows),
    "median deviation": r.middle("off"),
    "bias / stated": BIAS,
    "spread": r.scatter("off"),
    "stated, median": r.middle("error"),
    "spread / stated": r.scatter("in errors"),
    "bound, median": r.middle("bound"),
    "spread / bound": r.scatter("in bounds"),
    "covered": r.share("covered"),
    "named": r.share("is named"),
}
"""Columns of tables of `readings`."""


def false_alarms(by: str, healthy: Sequence[Record], groups: Sequence[str]) -> Iterator[Goal]:
    """Goals that false-alarm rates of healthy windows, from `judged`, match the declared ones."""
    for column, declared in zip(("any", "strict any"), RATES, strict=True):
        yield r.holding(f"{by}: false alarms of healthy windows", r.each(healthy, groups, r.share(column)), declared)
