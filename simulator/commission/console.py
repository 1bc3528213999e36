"""The commissioning's verdict in the terminal."""

from rich.console import Console
from rich.padding import Padding
from rich.table import Table
from rich.text import Text

from models.commissioning.report import CommissioningReport, ParameterSummary
from simulator.commission.units import parameter_value, percent
from simulator.commission.verdict import VERDICT_TEXT, budget_sentences, dominant, headline, next_steps, smallest_change

__all__ = ["print_report"]

_COLOURS = {"commissioned": "bold green", "passed": "green", "limited": "bold yellow", "refused": "bold red"}
_WIDE = 100


def print_report(report: CommissioningReport, console: Console | None = None) -> None:
    """Print verdict, checks and parameters.

    Parameters
    ----------
    console : rich.console.Console, optional
        The terminal without it. 80 columns suffice.
    """
    console = Console(highlight=False) if console is None else console
    verdict = Text(headline(report))
    verdict.highlight_words([VERDICT_TEXT[report.verdict]], style=_COLOURS[report.verdict])
    console.print(verdict)
    console.print(Text(f"knowledge level {report.level.value}: {report.level_text}"))
    console.print(_checks(report, narrow=console.width < _WIDE))
    if report.parameters:
        console.print(_parameters(report))
        for sentence in budget_sentences(report):
            console.print(Text(sentence))
    console.print(Text("\nWhat to do next", style="bold"))
    for number, step in enumerate(next_steps(report), start=1):
        console.print(Padding(Text(f"{number}. {step}"), (0, 0, 0, 2)))


def _checks(report: CommissioningReport, *, narrow: bool) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(max_width=20 if narrow else None)
    table.add_column(ratio=1)
    for check in report.checks:
        table.add_row(Text(check.verdict, style=_COLOURS[check.verdict]), Text(check.name), Text(check.text))
    return table


def _parameters(report: CommissioningReport) -> Table:
    identified = any(one.identified is not None for one in report.parameters)
    table = Table(
        box=None,
        padding=(0, 2, 0, 0),
        title="standard error of one window and of the commissioning; smallest change found",
        title_justify="left",
        title_style="",
    )
    table.add_column("parameter", no_wrap=True)
    if identified:
        table.add_column("identified", justify="right")
    for head in ("window", "commissioning"):
        table.add_column(head, justify="right", no_wrap=True)
    table.add_column("dominant")
    for head in ("loss", "gain"):
        table.add_column(head, justify="right")
    for one in report.parameters:
        table.add_row(*_cells(one, identified=identified))
    return table


def _cells(one: ParameterSummary, *, identified: bool) -> list[Text]:
    if not one.evaluable:
        return [Text(one.name), Text("not readable")]
    value = [Text("" if one.identified is None else parameter_value(one.name, one.identified))] if identified else []
    errors = [Text("–" if error is None else percent(error)) for error in (one.window_error, one.commissioning_error)]
    return [Text(one.name), *value, *errors, Text(dominant(one)), *map(Text, smallest_change(one))]
