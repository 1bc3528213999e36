"""Tables and figures of one machine on the results page."""

import textwrap
from collections.abc import Iterable, Iterator, Sequence

from models.physics.parameters import PARAMETERS
from simulator.campaigns.evaluation import RATES
from simulator.campaigns.evaluation_cells import Topic
from simulator.campaigns.evaluation_goals import (
    LAYOUT_TEXT,
    anomaly_text,
    excitation_text,
    length_exponent,
    percent,
    rate_text,
)
from simulator.campaigns.evaluation_summary import CellSummary, Interval, ParameterSummary, Summary, pooled
from simulator.campaigns.results_plots import figure_name, shows
from simulator.training.draws import Layout

__all__ = ["machine_section", "paragraph", "table"]


def machine_section(summary: Summary) -> list[str]:
    """Everything measured on one machine, as lines of Markdown under a heading of the second level."""
    name = summary.campaign.machine
    return [
        f"## Machine {name}",
        "",
        *_refused(summary),
        *_sharpness(summary),
        *_changes(summary),
        *_conditions(summary),
        *_alarms(summary),
        *_coverage(summary),
        *_power(summary),
        *_excitation(summary),
        *_length(summary),
        *_outside(summary),
        *_cost(summary),
    ]


def _figure(summary: Summary, name: str, text: str) -> list[str]:
    return [f"![{text}](figures/{figure_name(summary, name)})", ""] if shows(summary, name) else []


def _heading(summary: Summary, text: str) -> list[str]:
    return [f"### {text} ({summary.campaign.machine})", ""]


def _refused(summary: Summary) -> list[str]:
    lines = []
    for by in summary.diagnosticians:
        opinions = [cell.opinions[by] for cell in summary.cells if by in cell.opinions]
        refused = sum(one.refused for one in opinions)
        if refused:
            reasons: dict[str, int] = {}
            for one in opinions:
                for reason, count in one.reasons.items():
                    reasons[reason] = reasons.get(reason, 0) + count
            most = max(reasons, key=lambda reason: reasons[reason])
            lines += paragraph(
                f"- {by}: {refused} of {sum(one.n for one in opinions)} windows refused; most often: {most}",
                indent="  ",
            )
    return [*lines, ""] if lines else ["No window was refused.", ""]


def _sharpness(summary: Summary) -> list[str]:
    rows = []
    for layout in Layout:
        cells = summary.of(Topic.HEALTHY, layout=layout)
        for name in PARAMETERS:
            for by in summary.diagnosticians:
                for _, one in _read(cells, by, name):
                    rows.append(
                        (
                            LAYOUT_TEXT[layout],
                            name,
                            by,
                            "–" if one.bound is None else percent(one.bound, 3),
                            _spread(one),
                            _in_parentheses(one.spread_in_bounds),
                            percent(one.standard_error, 3),
                            _in_parentheses(one.spread_in_errors),
                            percent(one.bias, 3),
                            f"{one.n}",
                        )
                    )
    head = ("force", "parameter", "by", "bound", "spread", "spread / bound", "stated", "spread / stated", "bias", "n")
    return [
        *_heading(summary, "How sharp: healthy windows"),
        *table(head, rows),
        *_figure(summary, "spread", "Spread over the Cramér–Rao bound"),
    ]


def _changes(summary: Summary) -> list[str]:
    rows = []
    for cell in summary.of(Topic.SMALL, Topic.PAPER):
        truth = cell.truth or {}
        for name in truth:
            for by in summary.diagnosticians:
                for _, one in _read([cell], by, name):
                    rows.append(
                        (
                            _truth_text(truth),
                            LAYOUT_TEXT[cell.layout],
                            name,
                            by,
                            percent(one.median, 2),
                            _spread(one),
                            percent(one.standard_error, 3),
                            rate_text(one.covered),
                            *(rate_text(rate) for rate in one.found),
                        )
                    )
    head = ("true change", "force", "parameter", "by", "reads", "spread", "stated", "covered", *_named_at())
    return [
        *_heading(summary, "Changes: read and named"),
        *_figure(summary, "detection", "Windows in which the change is named, over its size"),
        *table(head, rows),
    ]


def _conditions(summary: Summary) -> list[str]:
    cells = summary.of(Topic.SMALL, Topic.PAPER)
    rows = []
    for truth in dict.fromkeys(_truth_text(cell.truth or {}) for cell in cells):
        same = [cell for cell in cells if _truth_text(cell.truth or {}) == truth]
        for by in summary.diagnosticians:
            opinions = [cell.opinions[by] for cell in same if by in cell.opinions]
            rows.append(
                (
                    truth,
                    by,
                    rate_text(pooled(one.exact[0] for one in opinions)),
                    rate_text(pooled(one.wrong[0] for one in opinions)),
                    rate_text(pooled(one.outside[0] for one in opinions)),
                )
            )
    return [
        *_heading(summary, "Which parameters: the set that is named"),
        *paragraph(f"Both layouts together, at {100 * RATES[0]:g} % false alarms per window."),
        "",
        *table(
            ("true change", "by", "exactly these named", "an unchanged one named", "called outside the model"), rows
        ),
    ]


def _alarms(summary: Summary) -> list[str]:
    rows = []
    for layout in (*Layout, None):
        cells = summary.of(Topic.HEALTHY, layout=layout)
        for by in summary.diagnosticians:
            opinions = [cell.opinions[by] for cell in cells if by in cell.opinions]
            rows.append(
                (
                    "both" if layout is None else LAYOUT_TEXT[layout],
                    by,
                    *(rate_text(pooled(one.any_named[at] for one in opinions)) for at in range(len(RATES))),
                    *(rate_text(pooled(one.outside[at] for one in opinions)) for at in range(len(RATES))),
                )
            )
    head = (
        "force",
        "by",
        *(f"a parameter named at {100 * rate:g} %" for rate in RATES),
        *(f"called outside the model at {100 * rate:g} %" for rate in RATES),
    )
    return [
        *_heading(summary, "False alarms: healthy windows"),
        *table(head, rows),
        *_figure(summary, "false-alarms", "Measured over declared false alarms"),
    ]


def _coverage(summary: Summary) -> list[str]:
    rows = []
    for layout in Layout:
        for name in PARAMETERS:
            for by in summary.diagnosticians:
                rates = [
                    pooled(one.covered for _, one in _read(summary.of(*topics, layout=layout), by, name))
                    for topics in ((Topic.HEALTHY,), (Topic.SMALL, Topic.PAPER))
                ]
                if any(rate is not None for rate in rates):
                    rows.append((LAYOUT_TEXT[layout], name, by, *(rate_text(rate) for rate in rates)))
    return [
        *_heading(summary, "95 % intervals"),
        *_figure(summary, "coverage", "Coverage of the 95 % intervals"),
        *table(("force", "parameter", "by", "healthy windows covered", "changed windows covered"), rows),
    ]


def _power(summary: Summary) -> list[str]:
    cells = [cell for cell in summary.of(Topic.DETECTABLE) if "likelihood" in cell.opinions]
    if not cells:
        return []
    rows = []
    for name in PARAMETERS:
        found = [
            pooled(one.found[0] for _, one in _read(_of(cells, layout), "likelihood", name) if one.found)
            for layout in Layout
        ]
        rows.append((name, *(rate_text(rate) for rate in found)))
    exact = [
        rate_text(pooled(cell.opinions["likelihood"].exact[0] for cell in _of(cells, layout))) for layout in Layout
    ]
    return [
        *_heading(summary, "Power at the quoted minimum detectable change"),
        *paragraph(
            "One parameter, drawn at random, is changed by what the likelihood quotes as just detectable (95 % power,",
            f"{100 * RATES[0]:g} % false alarms) in another realisation of the same condition.",
        ),
        "",
        *table(
            ("changed", *(f"it is named, {LAYOUT_TEXT[layout]}" for layout in Layout)),
            [*rows, ("any: exactly this one named", *exact)],
        ),
    ]


def _of(cells: Iterable[CellSummary], layout: Layout) -> list[CellSummary]:
    return [cell for cell in cells if cell.layout == layout]


def _excitation(summary: Summary) -> list[str]:
    untold = summary.of(Topic.EXCITATION)
    if not untold:
        return []
    rows = []
    for cell in [*summary.of(Topic.HEALTHY), *untold]:
        for by in summary.diagnosticians:
            if by not in cell.opinions:
                continue
            read = [one for one in cell.opinions[by].parameters if one.name != "EI"]
            if not read:
                continue
            biased = max(read, key=lambda one: abs(one.bias_in_errors.value))
            spread = max(read, key=lambda one: 0.0 if one.spread_in_errors is None else one.spread_in_errors.value)
            rows.append(
                (
                    excitation_text(cell.excitation),
                    LAYOUT_TEXT[cell.layout],
                    by,
                    f"{biased.name} {_in_parentheses(biased.bias_in_errors)}",
                    f"{spread.name} {_in_parentheses(spread.spread_in_errors)}",
                    rate_text(pooled(one.covered for one in read)),
                    rate_text(cell.opinions[by].any_named[0]),
                    rate_text(cell.opinions[by].outside[0]),
                )
            )
    head = (
        "force",
        "layout",
        "by",
        "largest bias / stated",
        "largest spread / stated",
        "covered, all but EI",
        f"a parameter named at {100 * RATES[0]:g} %",
        "called outside the model",
    )
    return [
        *_heading(summary, "Excitation the model was not told about"),
        *paragraph(
            "Healthy machines under a force of another colour than the assumed second-order low-pass, with a cutoff",
            "for every source, or with a level that changes over the window.",
        ),
        "",
        *_figure(summary, "excitation", "Bias and spread under other excitations"),
        *table(head, rows),
    ]


def _length(summary: Summary) -> list[str]:
    if not summary.of(Topic.LENGTH):
        return []
    rows, exponents = [], []
    for layout in Layout:
        cells = sorted(summary.of(Topic.LENGTH, Topic.HEALTHY, layout=layout), key=lambda cell: cell.length_s)
        for name in PARAMETERS:
            for cell, one in _read(cells, "likelihood", name):
                scaled = "–"
                if one.spread is not None:
                    scaled = percent(one.spread.value * (cell.length_s / summary.length_s) ** 0.5, 3)
                rows.append(
                    (
                        LAYOUT_TEXT[layout],
                        name,
                        f"{cell.length_s:g} s",
                        _spread(one),
                        scaled,
                        _in_parentheses(one.spread_in_bounds),
                        _in_parentheses(one.spread_in_errors),
                        f"{one.n}",
                    )
                )
        fitted = [(name, length_exponent(summary, layout, name)) for name in PARAMETERS]
        known = [f"{name} {_in_parentheses(one)}" for name, one in fitted if one is not None]
        if known:
            exponents += paragraph(f"- {LAYOUT_TEXT[layout]}: {', '.join(known)}", indent="  ")
    head = (
        "force",
        "parameter",
        "window",
        "spread",
        f"spread × √(T / {summary.length_s:g} s)",
        "spread / bound",
        "spread / stated",
        "n",
    )
    return [
        *_heading(summary, "Window length"),
        *_figure(summary, "length", "Spread over the window length"),
        *(["Exponent of the window length in the spread (−0.5 is 1/√T):", "", *exponents, ""] if exponents else []),
        *table(head, rows),
    ]


def _outside(summary: Summary) -> list[str]:
    cells = summary.of(Topic.OUTSIDE)
    if not cells:
        return []
    rows = []
    for cell in cells:
        for by in summary.diagnosticians:
            one = cell.opinions.get(by)
            if one is None or (by != "likelihood" and not one.misfit_z and not one.any_named[0].count):
                continue
            suspects = ", ".join(f"{suspect} ({count})" for suspect, count in list(one.suspects.items())[:3])
            rows.append(
                (
                    anomaly_text(cell.anomaly),
                    LAYOUT_TEXT[cell.layout],
                    by,
                    f"{one.n}",
                    f"{one.refused}",
                    rate_text(one.outside[0]),
                    rate_text(one.noticed[0]),
                    rate_text(one.claimed[0]),
                    rate_text(one.claimed_shaft[0]),
                    f"{one.misfit_z[2]:.1f}" if one.misfit_z else "–",
                    suspects or "–",
                )
            )
    head = (
        "what is wrong",
        "force",
        "by",
        "n",
        "refused",
        "called outside",
        "outside or suspect named",
        "bearing or unbalance claimed",
        "shaft claimed",
        "median misfit",
        "suspects (windows)",
    )
    return [
        *_heading(summary, "Outside the model"),
        *paragraph(
            "Faults that no diagnosed parameter describes. *Claimed* means named in a window that is not called",
            f"outside the model, at {100 * RATES[0]:g} %: a statement made without reserve, and wrong.",
            "A refused window claims nothing.",
        ),
        "",
        *_figure(summary, "outside", "Misfit and verdicts: healthy, other excitation, outside the model"),
        *table(head, rows),
    ]


def _cost(summary: Summary) -> list[str]:
    rows = []
    for by in summary.diagnosticians:
        spent = [
            cell.opinions[by].milliseconds
            for cell in summary.cells
            if by in cell.opinions and cell.topic is not Topic.LENGTH
        ]
        rows.append((by, f"{min(spent):.2g}", f"{max(spent):.2g}"))
    return [
        *_heading(summary, "Cost"),
        *paragraph(
            "Processor time of one diagnosis, statistics of the window at hand and the search started cold; median",
            "of a cell. Running on, the likelihood starts from the last window and is faster; that is measured by a",
            "benchmark.",
        ),
        "",
        *table(("by", "fastest cell, ms", "slowest cell, ms"), rows),
    ]


def _read(cells: Iterable[CellSummary], by: str, name: str) -> Iterator[tuple[CellSummary, ParameterSummary]]:
    for cell in cells:
        one = cell.opinions[by].parameter(name) if by in cell.opinions else None
        if one is not None:
            yield cell, one


def _truth_text(truth: dict[str, float]) -> str:
    return ", ".join(f"{name} {change:+.0%}" for name, change in truth.items()) or "healthy"


def _named_at() -> tuple[str, ...]:
    return tuple(f"named at {100 * rate:g} %" for rate in RATES)


def _spread(one: ParameterSummary) -> str:
    return "–" if one.spread is None else percent(one.spread.value, 3)


def _in_parentheses(interval: Interval | None) -> str:
    return "–" if interval is None else f"{interval.value:.2f} ({interval.low:.2f}–{interval.high:.2f})"


def paragraph(*sentences: str, indent: str = "") -> list[str]:
    """Sentences as lines of at most 118 characters; `indent` hangs under a list item."""
    return textwrap.wrap(" ".join(sentences), 118, subsequent_indent=indent, break_on_hyphens=False)


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Markdown table and an empty line."""
    return [
        f"| {' | '.join(head)} |",
        "|---" * len(head) + "|",
        *(f"| {' | '.join(row)} |" for row in rows),
        "",
    ]
