"""Faults other than changes of the diagnosed parameters: whether an alarm is raised, and which cause it names.

A machine is commissioned on healthy recordings of three conditions and watched by the monitor in one of these
conditions. After a healthy stretch one fault begins.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.results import Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Study
from benchmarks.studies.subjects.fault_kinds import ANOTHER, CRACK, FAULTS, HEALTHY, RUBS
from benchmarks.studies.subjects.machines import SHIPPED, SUBJECTS
from benchmarks.studies.subjects.watched import commissioned, raised
from benchmarks.studies.subjects.watched_machine import CONDITIONS, Subject
from models.alarm_names import CHANGED, DATA, LEVEL, MODEL, SHAPE
from models.commissioning.commissioned import Installed, KnowledgeLevel
from models.physics.rotor import PARAMETERS
from service.monitor.monitor import MachineMonitor

_FIRST_WINDOWS = 6
"""Windows before the fault without commissioning: five for the reference, and one that fills before comparison."""


def _measure(seed: int, name: str, level: KnowledgeLevel, _: None, number: int) -> list[dict[str, Value]]:
    subject = Subject(name, level, seed, number)
    installed = commissioned(subject.file, *map(subject.healthy, range(CONDITIONS)))
    # Rubs and cracks are not modelled for the finite-element rotor.
    faults = [fault for fault in FAULTS if fault != ANOTHER and (name in SHIPPED or fault not in {*RUBS, CRACK})]
    said: dict[str, Value] = {}
    if isinstance(installed, str):  # only levels can be watched, with the first windows as the reference
        said = {"refused": installed}
        subject, installed = replace(subject, windows=_FIRST_WINDOWS), Installed(subject.file)
    found = [{"fault": fault, **said, **_watched(subject, MachineMonitor(installed), fault)} for fault in faults]
    if level is KnowledgeLevel.FULL:  # present from the beginning, without commissioning
        subject = replace(subject, windows=0)
        found.append({"fault": ANOTHER, **_watched(subject, MachineMonitor(Installed(subject.file)), ANOTHER)})
    return found


def _watched(subject: Subject, monitor: MachineMonitor, fault: str) -> dict[str, Value]:
    """Alarms raised by a fault, and the causes that they name."""
    events = list(raised(monitor, subject.faulty(list(FAULTS).index(fault), fault, FAULTS[fault])))
    after = [one for one in events if one.at_s > subject.begins_s]
    named = [one for one in after if one.name in PARAMETERS]
    standing = [one for one in monitor.health().alarms if one.name in PARAMETERS and one.raised]
    return {
        "early": ", ".join(one.name for one in events if one.at_s <= subject.begins_s),
        "heard": bool(after),
        "named": bool(named),
        "named at first without reserve": any(not one.low_confidence for one in named),
        "without reserve": any(not one.low_confidence for one in standing),
        "blamed": ", ".join(dict.fromkeys(one.name for one in named)),
        "levels": any(one.name.startswith(LEVEL) for one in after),
        "model": any(one.name in {MODEL, SHAPE} for one in after),
        "changed": any(one.name == CHANGED for one in after),
        "data": any(one.name.startswith(DATA) for one in after),
        "delay_s": after[0].at_s - subject.begins_s if after else None,
        "first": after[0].name.split(":")[0] if after else "",
        "suspect": next((one.note for one in after if one.name == MODEL), ""),
    }


# Tables and goals


def _heard(rows: Sequence[Record], *, refused: bool = False) -> list[Record]:
    return [row for row in rows if ("refused" in row) == refused and row["fault"] != HEALTHY]


_COLUMNS = {
    "streams": len,
    "heard": r.share("heard"),
    "by levels": r.share("levels"),
    "outside the model": r.share("model"),
    "sensor or data": r.share("data"),
    "k, c or e named": r.share("named"),
    "at first without reserve": r.share("named at first without reserve"),
    "left without reserve": r.share("without reserve"),
    "delay, median s": r.middle("delay_s"),
}
_TABLES = (
    Table("other-faults", ("fault",), _COLUMNS, _heard, "Fault by fault:"),
    Table("other-faults-machines", ("machine", "level"), _COLUMNS, _heard, "Machine by machine:"),
    Table(
        "other-faults-healthy",
        ("machine", "level"),
        {
            "streams": len,
            "commissioning refused": lambda rows: r.rate("refused" in row for row in rows),
            "an alarm": lambda rows: r.rate(row["heard"] or row["early"] for row in rows),
            "outside the model": r.share("model"),
        },
        partial(r.where, fault=HEALTHY),
        "The same streams without a fault:",
    ),
    Table(
        "other-faults-watched",
        ("machine",),
        {name: _COLUMNS[name] for name in ("streams", "heard", "by levels", "delay, median s")},
        partial(_heard, refused=True),
        "Where the commissioning was refused, by levels alone, against the first five windows:",
    ),
    Table("other-faults-each", ("machine", "level", "fault"), _COLUMNS, _heard),
)


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    rows = _heard(records)
    other = [row for row in rows if not str(row["fault"]).startswith("no rotor")]
    foreign = [row for row in rows if str(row["fault"]).startswith("no rotor")]
    yield r.at_most("k, c or e left named without reserve", r.share("without reserve")(other), 0.01)
    yield r.at_least("heard", r.share("heard")(other), 0.99)
    yield r.at_most("no rotor of the file: k, c or e alarmed", r.share("named")(foreign), 0.01)


def other_faults(options: Options) -> Study:
    """Faults of other kinds, on machines of every class."""
    known = (KnowledgeLevel.FULL, KnowledgeLevel.NONE)
    plan = [(name, level) for name in SHIPPED for level in known]
    plan += [(name, KnowledgeLevel.NONE) for name in SUBJECTS if name not in SHIPPED]
    if options.small:
        plan = [("lab", KnowledgeLevel.NONE)]
    cells = tuple(
        Cell({"machine": name, "level": level.value}, options.windows, partial(_measure, options.seed, name, level))
        for name, level in plan
    )
    return Study("other_faults", cells, _TABLES, _goals)
