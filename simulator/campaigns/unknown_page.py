"""The section about machines that were commissioned without parameters, for the page of measured results."""

from collections.abc import Sequence

from models.commissioning.knowledge import KnowledgeLevel
from simulator.campaigns.evaluation_goals import LAYOUT_TEXT, percent, rate_text
from simulator.campaigns.rates import Rate
from simulator.campaigns.results_tables import paragraph, table
from simulator.campaigns.unknown_summary import CellSummary, UnknownSummary, pooled
from simulator.training.draws import Layout

__all__ = ["BEGIN", "END", "placed", "unknown_section"]

BEGIN = "<!-- machines without parameters: begin, written by rotortrain unknown -->"
END = "<!-- machines without parameters: end -->"

_LOCATED = 0.95
_OTHER = 0.01


def unknown_section(summary: UnknownSummary) -> str:
    """Markdown between its two marks."""
    several = summary.conditions > 1
    heading = f", commissioned in {summary.conditions} conditions" if several else ""
    begin, end = (mark.replace("parameters", f"parameters{heading}", 1) for mark in (BEGIN, END))
    lines = [
        begin,
        f"## Machines without parameters{heading}",
        "",
        *paragraph(*_introduction(summary)),
        "",
        *_machines(summary),
        *_goals(summary),
    ]
    for level, name in summary.pairs:
        if level is KnowledgeLevel.NONE:
            lines += _details(summary, name)
    return "\n".join([*lines, *_command(summary), end]) + "\n"


def placed(page: str, section: str) -> str:
    """The page with this section in the place of the one it has, or at its end.

    Parameters
    ----------
    page : str
    section : str
        Its first and last line are the marks between which it stands.
    """
    first, *_, last = section.rstrip().splitlines()
    before, begin, rest = page.partition(first)
    _, end, after = rest.partition(last)
    if not begin or not end:
        return page.rstrip() + "\n\n" + section
    return before + section.rstrip() + after


def _introduction(summary: UnknownSummary) -> tuple[str, ...]:
    return (
        "Level *none*: the monitor knows channels and sampling and nothing of the rotor; *partial*: masses and shaft,",
        "as an engineer would weigh and measure them; *full*: all parameters. Finite-element rotors, which",
        "are another model class than the monitor's own, and the shipped machines with their parameters kept secret.",
        f"Every machine is commissioned {summary.commissionings} times from scratch, each time on",
        f"{summary.healthy_windows} healthy windows of 60 s with one source of random direction, one cutoff (40 to",
        f"160 Hz) and one level{_several(summary)}.",
        "Every window read later has a cutoff at least a quarter off the (first) commissioned one, and",
        "level, noise and direction of its own; one source and independent sources in turn.",
        "Only the bearing that stiffens with its displacement stays within a tenth of the commissioned level, because",
        "at another one it has another stiffness.",
        f"{summary.windows} windows of 60 s per true change, {percent(summary.rate, 0)} false alarms declared per",
        f"window, seed {summary.seed}. *Located* means that exactly the changed parameter is named. Intervals are",
        "Clopper–Pearson's at 95 % and take windows as independent; those of one commissioning share its error, so the",
        "least of the commissionings stands beside. A stiffness is read relative to all that holds the bearing, a",
        "shaft that is held elsewhere included: *covered* for a changed one counts that as an error.",
    )


def _several(summary: UnknownSummary) -> str:
    return f", and as many of each of {summary.conditions - 1} more such conditions" if summary.conditions > 1 else ""


def _machines(summary: UnknownSummary) -> list[str]:
    rows = []
    for level, name in summary.pairs:
        cells = {_key(cell): cell for cell in summary.of(level, name)}
        healthy, changed = cells.get(""), [cell for key, cell in cells.items() if key]
        if healthy is None:
            continue
        rows.append(
            (
                level,
                f"**{name}**: {summary.machines[name]}",
                rate_text(healthy.detected),
                *(_located(changed, kind) for kind in ("k", "c", "e")),
                rate_text(pooled(cell.other for cell in changed)),
                rate_text(healthy.outside),
                rate_text(_covered([healthy, *changed], changed=False)),
            )
        )
    head = (
        "level",
        "machine",
        "healthy: any named",
        "k −10 % located",
        "c −30 % located",
        "e +20 % located",
        "changed: another one named",
        "healthy: outside the model",
        "unchanged parameters covered",
    )
    return table(head, rows)


def _goals(summary: UnknownSummary) -> list[str]:
    rows = []
    for level, name in summary.pairs:
        cells = summary.of(level, name)
        bearing = [cell for cell in cells if cell.truth and "e" not in cell.truth]
        for kind, change in (("k", "−10 %"), ("c", "−30 %")):
            rate = pooled(cell.exact for cell in bearing if next(iter(cell.truth)).startswith(kind))
            rows.append(
                (level, name, f"{kind} {change} located in at least 95 %", rate, rate and rate.rate >= _LOCATED)
            )
        rate = pooled(cell.other for cell in bearing)
        rows.append((level, name, "another parameter named in at most 1 %", rate, rate and rate.rate <= _OTHER))
        rate = pooled(cell.detected for cell in cells if not cell.truth)
        rows.append(
            (
                level,
                name,
                f"false alarms at the declared {percent(summary.rate, 0)}",
                rate,
                rate and rate.low <= summary.rate,
            )
        )
    met = [row for row in rows if row[4]]
    missed = [
        (level, name, what, rate_text(rate)) for level, name, what, rate, good in rows if rate is not None and not good
    ]
    lines = paragraph(
        "Wanted: k −10 % and c −30 % located in at least 95 % of windows, another parameter named in at most 1 %,",
        f"false alarms at the declared rate within its interval. {len(met)} met, {len(missed)} missed.",
    )
    return [*lines, "", *(table(("level", "machine", "wanted", "measured"), missed) if missed else [])]


def _details(summary: UnknownSummary, name: str) -> list[str]:
    rows = []
    for layout in Layout:
        for cell in summary.of(KnowledgeLevel.NONE, name, layout):
            changed = next(iter(cell.truth), None)
            reading = cell.readings.get(changed) if changed else None
            read = "–" if reading is None else f"{percent(reading.median)} ± {percent(reading.median_error)}"
            rows.append(
                (
                    LAYOUT_TEXT[layout],
                    _key(cell) or "healthy",
                    rate_text(cell.detected),
                    rate_text(cell.exact),
                    percent(min(one.rate for one in cell.by_commissioning), 0),
                    rate_text(cell.other),
                    rate_text(cell.outside),
                    rate_text(cell.refused) if cell.refused.count else "0",
                    read,
                    "–" if reading is None else _short(reading.covered),
                    _short(_covered([cell], changed=False)),
                )
            )
    head = (
        "sources",
        "true change",
        "any named",
        "exactly right",
        "least commissioning",
        "another named",
        "outside the model",
        "refused",
        "it reads",
        "covered",
        "others covered",
    )
    return [f"### {name}, level none", "", *table(head, rows)]


def _command(summary: UnknownSummary) -> list[str]:
    options = [f"--level {level}" for level in dict.fromkeys(level for level, _ in summary.pairs)]
    machines = " ".join([*options, *(f"--machine {name}" for name in summary.machines)])
    return [
        "```sh",
        f"rotortrain unknown {machines} --windows {summary.windows} --commissionings {summary.commissionings} "
        f"--healthy {summary.healthy_windows} --conditions {summary.conditions} --seed {summary.seed} "
        "--out unknown --page docs/results.md",
        "```",
        "",
    ]


def _key(cell: CellSummary) -> str:
    return ", ".join(f"{name} {change:+.0%}" for name, change in cell.truth.items())


def _located(cells: Sequence[CellSummary], kind: str) -> str:
    return rate_text(pooled(cell.exact for cell in cells if next(iter(cell.truth)).startswith(kind)))


def _covered(cells: Sequence[CellSummary], *, changed: bool) -> Rate | None:
    return pooled(
        reading.covered for cell in cells for name, reading in cell.readings.items() if (name in cell.truth) == changed
    )


def _short(rate: Rate | None) -> str:
    return "–" if rate is None else percent(rate.rate, 0)
