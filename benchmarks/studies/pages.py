"""Pages of the documents, written from the records of the studies, with all figures as CSV beside them."""

import textwrap
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from benchmarks.studies.plots import draw
from benchmarks.studies.results import Chart, Estimate, Goal, Record, Value
from benchmarks.studies.study import Options, Study

__all__ = ["TEXTS", "Measured", "write_page"]


TEXTS: dict[str, Any] = tomllib.loads((Path(__file__).parent / "texts.toml").read_text(encoding="utf-8"))
"""Words of the pages, and which studies stand on them (``pages``)."""


@dataclass(frozen=True, slots=True)
class Measured:
    """A study with its records, and what it was run with."""

    study: Study
    options: Options
    records: Sequence[Record]


def write_page(name: str, parts: Sequence[Measured], docs: Path) -> list[Path]:
    """Write a page, its charts into ``figures/`` and its tables into ``results/`` beside it; returns what was written.

    Raises
    ------
    OSError
        If something cannot be written.
    """
    figures, results = docs / "figures", docs / "results"
    written = []
    shown = []
    for part in parts:
        figures.mkdir(parents=True, exist_ok=True)
        results.mkdir(exist_ok=True)
        study, records = part.study, part.records
        charts: list[Chart] = list(study.charts(records))
        written += [draw(chart, figures) for chart in charts]
        tables = [table.write(records, results) for table in study.tables]
        written += tables
        goals: list[Goal] = list(study.goals(records))
        verdicts = [goal.verdict for goal in goals]
        windows = len({(*(record[key] for key in study.cells[0].keys), record["number"]) for record in records})
        numbers = {"windows": part.options.windows, "seed": part.options.seed, "total": windows}
        shown.append(
            {
                **{word: text.format(**numbers) for word, text in TEXTS[study.name].items()},
                "tables": [(table.page, table.of(records)) for table in study.tables if table.page],
                "goals": goals,
                "verdicts": tuple(verdicts.count(one) for one in ("met", "missed", "within chance")),
                "charts": charts,
                "files": [f"[{path.name}](results/{path.name})" for path in tables],
                "command": _command(part),
            }
        )
    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=False,  # noqa: S701  # Markdown
    )
    environment.filters |= {"wrapped": _wrapped, "figure": _figure}
    text = environment.get_template("page.md.jinja").render(parts=shown, **{"introduction": ""} | TEXTS["pages"][name])
    path = docs / f"{name}.md"
    path.write_text(text.rstrip() + "\n", encoding="utf-8")
    return [path, *written]


def _wrapped(text: str) -> str:
    return textwrap.fill(" ".join(text.split()), 120, break_on_hyphens=False, break_long_words=False)


def _figure(value: Value | Estimate) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _command(part: Measured) -> str:
    options = part.options
    machines = "".join(f" --machine {name}" for name in options.machines)
    return (
        f"python -m benchmarks.studies {part.study.name}{machines} --windows {options.windows} --seed {options.seed}"
        + (" --small" if options.small else "")
        + " --out OUT --docs docs"
    )
