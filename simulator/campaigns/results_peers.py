"""The section of the results page about what a user would otherwise pick, and where that wins."""

from collections.abc import Iterator
from pathlib import Path

from simulator.campaigns.evaluation_goals import rate_text
from simulator.campaigns.peers_campaign import SETTINGS, Comparison, ComparisonCell
from simulator.campaigns.peers_command import draw_comparison
from simulator.campaigns.results_tables import paragraph, table
from simulator.campaigns.study_plots import METHOD_TEXT
from simulator.campaigns.written import read_numbers

__all__ = ["peers_section"]

_OURS = ("relation", "network", "likelihood")


def peers_section(path: Path, figures: Path) -> tuple[str, Path]:
    """Markdown of the section, and the figure drawn for it.

    Parameters
    ----------
    path : Path
        What `rotortrain peers` wrote.
    figures : Path
        Folder for the figure.

    Raises
    ------
    RecordingError
        If the numbers cannot be read.
    """
    comparison = read_numbers(Comparison, path)
    figure = draw_comparison(comparison, figures / "results-peers.png")
    methods = tuple(comparison.cells[0].methods)
    lines = [
        f"## Beside other methods ({comparison.machine})",
        "",
        *paragraph(
            f"{comparison.windows} windows per change and setting, {comparison.healthy_windows} healthy windows to",
            f"learn from and as many to set the limits, {100 * comparison.false_alarm_rate:g} % false alarms declared",
            f"for every method, seed {comparison.seed}. *Something*: said to have changed; *exactly*: the right",
            "parameters (for the printed networks: equations) are named, and no others.",
        ),
        "",
        f"![Detected and named exactly](figures/{figure.name})",
        "",
        "Where another method says more often that something has changed (intervals do not overlap):",
        "",
        *_others_win(comparison),
        "",
        "The others say that, never which parameter or by how much; the printed networks name equations.",
        "",
    ]
    for setting in SETTINGS:
        rows = []
        for cell in (cell for cell in comparison.cells if cell.setting == setting):
            rates = [cell.methods[method] for method in methods]
            rows.append((_change(cell), "something", *(rate_text(one.detected) for one in rates)))
            rows.append((_change(cell), "exactly", *(rate_text(one.exact) for one in rates)))
        lines += [f"### In the setting “{setting}”", "", *table(("true change", "named", *methods), rows)]
    return "\n".join(lines), figure


def _change(cell: ComparisonCell) -> str:
    return ", ".join(f"{name} {size:+.0%}" for name, size in cell.faults.items()) or "healthy"


def _others_win(comparison: Comparison) -> Iterator[str]:
    for setting in SETTINGS:
        for own in _OURS:
            won: dict[str, list[str]] = {}
            for cell in (cell for cell in comparison.cells if cell.setting == setting and cell.faults):
                if own not in cell.methods:
                    continue
                best = cell.methods[own].detected
                for name, rates in cell.methods.items():
                    if name not in _OURS and rates.detected.low > best.high:
                        percents = f"{100 * rates.detected.rate:g} against {100 * best.rate:g} %"
                        won.setdefault(name, []).append(f"{_change(cell)} ({percents})")
            said = "; ".join(f"{METHOD_TEXT.get(name, name)} at {', '.join(cases)}" for name, cases in won.items())
            yield from paragraph(f"- {setting}, {METHOD_TEXT[own]}: {said or 'nowhere'}.", indent="  ")
