"""Writes the documentation page of a study from its records, and all figures as CSV files."""

import textwrap
import tomllib
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from benchmarks.studies.reporting.plots import draw
from benchmarks.studies.reporting.results import Figure, Record
from benchmarks.studies.reporting.study import Options, Study

_HERE = Path(__file__).parent
_TEXTS = tomllib.loads((_HERE / "texts.toml").read_text(encoding="utf-8"))


def write_page(study: Study, options: Options, records: Sequence[Record], docs: Path) -> list[Path]:
    """Write a page, and its charts to ``figures/`` and tables to ``results/`` beside it; returns the files written.

    Raises OSError if something cannot be written.
    """
    figures, results = docs / "figures", docs / "results"
    for folder in (figures, results):
        folder.mkdir(parents=True, exist_ok=True)
    charts, goals = list(study.charts(records)), list(study.goals(records))
    filled = [table for table in study.tables if table.of(records)]
    tables = [table.write(records, results) for table in filled]
    verdicts = [goal.verdict for goal in goals]
    keys = [*study.cells[0].keys, "number"]
    numbers = {
        "windows": options.windows,
        "seed": options.seed,
        "machine": (options.machines or ("lab",))[0],
        "total": len({tuple(record[key] for key in keys) for record in records}),
    }
    words = _TEXTS[study.name]
    environment = Environment(
        loader=FileSystemLoader(_HERE),
        undefined=StrictUndefined,
        trim_blocks=True,
        autoescape=False,  # noqa: S701  # Markdown
    )
    environment.filters |= {"wrapped": _wrapped, "figure": _figure}
    text = environment.get_template("page.md.jinja").render(
        title=words["title"],
        text=words["text"].format(**numbers),
        fails=words["fails"].format(**numbers),
        tables=[(table.page, table.of(records)) for table in filled if table.page],
        goals=goals,
        verdicts=tuple(verdicts.count(one) for one in ("met", "missed", "within chance")),
        charts=charts,
        files=[f"[{path.name}](results/{path.name})" for path in tables],
        command=_command(study, options),
    )
    page = docs / f"{words['page']}.md"
    page.write_text(text.rstrip() + "\n", encoding="utf-8")
    return [page, *(draw(chart, figures) for chart in charts), *tables]


def _wrapped(text: str) -> str:
    return textwrap.fill(" ".join(text.split()), 120, break_on_hyphens=False, break_long_words=False)


def _figure(value: Figure) -> str:
    if value is None:
        return "–"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _command(study: Study, options: Options) -> str:
    parts = [f"python -m benchmarks.studies {study.name}", *(f"--machine {name}" for name in options.machines)]
    parts += [f"--windows {options.windows} --seed {options.seed}", *(["--small"] if options.small else [])]
    return " ".join([*parts, "--out OUT --docs docs"])
