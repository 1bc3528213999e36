"""The results page, written from the numbers of one or several machines."""

from collections.abc import Sequence

from simulator.campaigns.evaluation_goals import Goal, goals
from simulator.campaigns.evaluation_summary import Summary
from simulator.campaigns.results_tables import machine_section, paragraph, table

__all__ = ["page"]

_MACHINE_ORDER = ("lab", "heavy", "light")
_INTRODUCTION = (
    "What the diagnosticians find on simulated machines, on windows that neither training nor calibration saw. Every",
    "window is an independent realisation in a condition of its own: cutoff and level of the stochastic force, its",
    "distribution over the machine, speed, and sensor noise are drawn at random within the ranges of the machine",
    "file. *Independent sources* act at bearing and disc in both planes with random levels; *one source* acts on all",
    "six degrees of freedom in a random direction. The *likelihood* decides alarms; the *amortised networks* and the",
    "*equations' networks* (the paper's relations, trained) stand beside it.",
)
_READING = (
    "*Spread* is a robust standard deviation over windows of reading minus truth. *Bound* is the Cramér–Rao bound,",
    "the least standard error that any unbiased method can have in that window; it varies from window to window, so",
    "every window is measured against its own before the spread is taken. *Stated* is the median standard error that",
    "the windows state for themselves, *covered* the share of windows whose 95 % interval holds the truth, *named*",
    "the share in which the parameter is said to have changed at a declared rate of false alarms per window, all",
    "parameters together. Intervals in parentheses are at 95 %: Clopper–Pearson for rates, resampled windows for",
    "spreads. A refused window counts as one in which nothing is named. *Within chance* in the table of goals means",
    "that the interval reaches across the goal: more windows could turn the verdict. A row about several parameters",
    "shows the one farthest off, which chance alone drives outwards when there are many. *At the bound* is the share",
    "of windows in which an unbiased reading as sharp as the Cramér–Rao bound would cross the same threshold: a goal",
    "above it asks for more than the windows hold.",
)
_FAILS = (
    "Simulation is not a machine: the rotor that makes the windows and the rotor that reads them have the same",
    "equations of motion (except in the cells outside the model), and every parameter that is not diagnosed has the",
    "value of the machine file. Nothing here says how a wrong mass or length in the machine file shows. A window is",
    "judged by itself; what a stretch of windows finds, and how soon, is another measurement. With one source of",
    "force the bound is set by sensor noise and lies far below what segments of finite length can resolve: spreads",
    "are small there in percent and large in bounds.",
)


def page(summaries: Sequence[Summary], extra_sections: Sequence[str]) -> str:
    """Markdown page; figures are expected beside it in ``figures/``.

    Parameters
    ----------
    summaries : sequence of Summary
        At least one machine.
    extra_sections : sequence of str
        Markdown of what other commands measured, each with a heading of the second level.

    Raises
    ------
    ValueError
        Without any summary.
    """
    if not summaries:
        raise ValueError("no summaries, expected those of at least one machine")
    ordered = sorted(summaries, key=_order)
    judged = [goal for summary in ordered for goal in goals(summary)]
    lines = [
        "# Measured results",
        "",
        *paragraph(*_INTRODUCTION),
        "",
        *paragraph(*_READING),
        "",
        *_made_with(ordered),
        *_goal_table(judged),
        *_failures(judged),
    ]
    for summary in ordered:
        lines += machine_section(summary)
    for section in extra_sections:
        lines += [section.strip(), ""]
    return "\n".join(lines)


def _order(summary: Summary) -> tuple[int, str]:
    name = summary.campaign.machine
    return (_MACHINE_ORDER.index(name) if name in _MACHINE_ORDER else len(_MACHINE_ORDER), name)


def _made_with(summaries: Sequence[Summary]) -> list[str]:
    rows, commands = [], []
    for summary in summaries:
        made = summary.campaign
        rows.append(
            (
                made.machine,
                f"{summary.length_s:g} s",
                f"{made.windows}",
                f"{len({cell.cell for cell in summary.cells})}",
                f"{summary.windows}",
                f"{made.seed}",
                f"`{made.bundle}`" if made.bundle else "none: likelihood only",
                f"`{made.physics}`",
            )
        )
        command = f"rotortrain evaluate --machine {made.machine}"
        command += f" --bundle {made.bundle_name}" if made.bundle_name else ""
        command += f" --windows {made.windows} --fault {made.fault:g} --seed {made.seed}"
        commands.append(command + (" --full" if made.full else "") + " --out evaluation --page docs/results.md")
    head = ("machine", "window", "windows per cell", "cells", "windows in all", "seed", "bundle", "physics")
    return [*table(head, rows), "```sh", *commands, "```", ""]


def _goal_table(judged: Sequence[Goal]) -> list[str]:
    met = sum(goal.met is True for goal in judged)
    missed = sum(goal.met is False for goal in judged)
    return [
        "## Declared goals",
        "",
        *paragraph(f"{met} met, {missed} missed, {len(judged) - met - missed} without a verdict."),
        "",
        *table(
            ("machine", "goal", "declared", "measured", "met"),
            [(goal.machine, goal.what, goal.declared, goal.measured, goal.verdict) for goal in judged],
        ),
    ]


def _failures(judged: Sequence[Goal]) -> list[str]:
    lines = ["## Where it fails", ""]
    for text in _FAILS:
        lines += paragraph(text)
    missed = [goal for goal in judged if goal.met is False]
    lines.append("")
    if not missed:
        return [*lines, "No declared goal was missed.", ""]
    certain = [goal for goal in missed if goal.certain]
    for title, group in (("Missed beyond chance:", certain), ("Missed, within chance:", missed)):
        shown = [goal for goal in group if goal.certain == (group is certain)]
        if shown:
            lines += [title, ""]
            for goal in shown:
                text = f"- {goal.machine}, {goal.what}: {goal.measured}, declared {goal.declared}."
                lines += paragraph(text, indent="  ")
            lines.append("")
    return lines
