"""The page about the paper's study, written from its numbers."""

import textwrap

from models.diagnosis.networks.paper import PAPER_EQUATIONS
from simulator.campaigns.rates import Rate
from simulator.campaigns.study import REALISATIONS, Study
from simulator.campaigns.study_windows import CONDITIONS, EQUATIONS, own_equations

__all__ = ["METHOD_NAMES", "study_page"]

METHOD_NAMES = {
    "paper": "the paper's networks as printed",
    "relation": "the equations' networks",
    "network": "the amortised networks",
    "likelihood": "the likelihood",
}


def study_page(study: Study) -> str:
    """Markdown page with figures beside it in ``figures/``."""
    return "\n".join(
        [
            *_introduction(study),
            *_comparison(study),
            *_conclusions(study),
            *_figures(study),
            *_noise(study),
            *_conditions(study),
        ]
    )


def _paragraph(*sentences: str, indent: str = "") -> list[str]:
    """Sentences as lines of at most 118 characters; `indent` hangs under a list item."""
    return textwrap.wrap(" ".join(sentences), 118, subsequent_indent=indent, break_on_hyphens=False)


def _introduction(study: Study) -> list[str]:
    return [
        "# The paper's study, done again",
        "",
        *_paragraph(
            "The eight fault conditions of the paper (its Table 2, each change 20 %), four cutoffs of the",
            "excitation and",
            "1 to 5 % coloured noise in the output, judged by the paper's networks exactly as printed and by this",
            "project's own diagnosticians, on the same windows. Everything is done twice: on faulty runs that share",
            "the",
            "noise realisation of the healthy runs on which the printed networks were trained, as the paper",
            "evidently had",
            "it, and on independent realisations, which is what a machine delivers.",
        ),
        "",
        *_paragraph(
            f"Machine {study.machine}, bundle {study.bundle}, {study.speed_rpm:g} rpm, one source of fixed",
            "direction and",
            f"level, cutoffs {', '.join(study.force_rms_N)} Hz, stochastic displacement at the disc as large as the 1×",
            f"displacement, {study.windows} windows of each condition, cutoff and kind of realisation; seed",
            f"{study.seed}.",
            f"The printed networks were trained on {study.training_windows} healthy windows. Their limits for",
            "independent",
            f"data come from {study.calibration_windows} further healthy windows at a declared rate of",
            f"{study.false_alarm_rate:.0%} false alarms per window, all equations together; for shared data the",
            "limit is",
            "the largest MSD among the training windows. Rates have 95 % Clopper-Pearson intervals. Made with",
        ),
        "",
        "```sh",
        f"rotortrain reproduce --machine {study.machine} --out docs --windows {study.windows} "
        f"--calibration {study.calibration_windows} --false-alarms {study.false_alarm_rate:g} --seed {study.seed}",
        "```",
        "",
    ]


def _comparison(study: Study) -> list[str]:
    lines = [
        "## Who finds what",
        "",
        "| realisations | method | exactly the changed equations | changed equations named | an unchanged one named "
        "| healthy windows flagged |",
        "|---|---|---|---|---|---|",
    ]
    for realisation in REALISATIONS:
        for method in study.methods:
            rates = (
                study.exact(realisation, method),
                study.found(realisation, method),
                study.wrong(realisation, method),
                study.false_alarms(realisation, method),
            )
            lines.append(
                f"| {realisation} | {METHOD_NAMES[method]} | " + " | ".join(_text(rate) for rate in rates) + " |"
            )
    refused = [f"{METHOD_NAMES[method]}: {study.refused(method)}" for method in study.methods if study.refused(method)]
    if refused:
        lines += ["", f"Windows that could not be judged, and count as not named: {'; '.join(refused)}."]
    return [*lines, "", "![Share of windows in which an equation is named](figures/reproduction-location.png)", ""]


def _conclusions(study: Study) -> list[str]:
    shared, independent = (study.exact(realisation, "paper") for realisation in REALISATIONS)
    seen, found = (study.found(realisation, "paper") for realisation in REALISATIONS)
    wrong = study.wrong("independent", "paper")
    lines = [
        "## What the numbers say",
        "",
        *_paragraph(
            "- **As printed**, the networks name exactly the changed equations in",
            f"{_text(shared)} of the windows with shared realisations and in {_text(independent)} with independent",
            "ones:",
            f"{_compared(shared, independent)}. Of the changed equations they name {_text(seen)} with shared and",
            f"{_text(found)} with independent realisations: {_compared(seen, found)}. On independent data they name an",
            f"unchanged equation in {_text(wrong)} of the windows: {_locating(independent, found)}.",
            indent="  ",
        ),
        *_by_equation(study),
    ]
    for method in study.methods[1:]:
        one, other = (study.exact(realisation, method) for realisation in REALISATIONS)
        lines += _paragraph(
            f"- **{METHOD_NAMES[method].capitalize()}**: exact in {_text(one)} with shared and {_text(other)} with",
            f"independent realisations ({_compared(one, other)}).",
            indent="  ",
        )
    alarms = {method: study.false_alarms("independent", method) for method in study.methods}
    above = [
        f"{METHOD_NAMES[method]} ({_text(rate)})"
        for method, rate in alarms.items()
        if rate.low > study.false_alarm_rate
    ]
    if above:
        lines += _paragraph(
            f"- More false alarms than the declared {study.false_alarm_rate:.0%} on independent healthy windows,",
            "beyond",
            f"chance: {', '.join(above)}.",
            indent="  ",
        )
    return [*lines, ""]


def _by_equation(study: Study) -> list[str]:
    """How often each printed equation is named where it should and where it should not be."""
    lines = []
    for equation in PAPER_EQUATIONS:
        own = [c.number for c in CONDITIONS[1:] if equation.number in own_equations(c)]
        other = [c.number for c in CONDITIONS[1:] if c.number not in own]
        rates = []
        for numbers in (own, other):
            parts = [study.naming("independent", number, "paper", equation.number) for number in numbers]
            rates.append(Rate.of_counts(sum(p.count for p in parts), sum(p.of for p in parts)) if parts else None)
        where = "no fault condition concerns it" if rates[0] is None else f"its own faults {_text(rates[0])}"
        foreign = "" if rates[1] is None else f", faults that are not its own {_text(rates[1])}"
        lines.append(f"  - equation {equation.number} ({equation.title}) deviates at: {where}{foreign}")
    return lines


def _figures(study: Study) -> list[str]:
    return [
        "## Deviations over the cutoff (the paper's Figs. 4 to 6)",
        "",
        "![Excitation](figures/reproduction-excitation.svg)",
        "",
        *_paragraph(
            "Mean squared deviation between the printed networks' output and the estimated correlation, over the",
            "limit.",
            "With shared realisations:",
        ),
        "",
        "![MSD with shared realisations](figures/reproduction-msd-shared.png)",
        "",
        "The same with independent realisations:",
        "",
        "![MSD with independent realisations](figures/reproduction-msd-independent.png)",
        "",
        *_paragraph(f"Limits of the MSD: {_limits(study)}."),
        "",
    ]


def _limits(study: Study) -> str:
    parts = []
    for realisation in REALISATIONS:
        values = ", ".join(f"({equation}) {study.limits[realisation][equation]:.2g}" for equation in EQUATIONS)
        parts.append(f"{realisation} {values}")
    return "; ".join(parts)


def _noise(study: Study) -> list[str]:
    cells = [cell for cell in study.noise if cell.realisation == "independent"]
    lines = [
        "## Noise in the output (the paper's Fig. 7)",
        "",
        f"Healthy machine, cutoff {cells[0].cutoff_hz:g} Hz.",
        "",
        "![MSD over the noise in the output](figures/reproduction-noise.png)",
        "",
        "Healthy windows flagged, independent realisations:",
        "",
        "| method | " + " | ".join(f"{cell.noise_relative:.0%} noise" for cell in cells) + " |",
        "|---" * (len(cells) + 1) + "|",
    ]
    for method in study.methods:
        flagged = [Rate.of_counts(sum(map(bool, cell.named[method])), len(cell.named[method])) for cell in cells]
        lines.append(
            f"| {METHOD_NAMES[method]} | " + " | ".join(f"{rate.count} of {rate.of}" for rate in flagged) + " |"
        )
    return [*lines, ""]


def _conditions(study: Study) -> list[str]:
    lines = ["## Fault conditions", "", "| number | paper | here | equations |", "|---|---|---|---|"]
    for condition in CONDITIONS[1:]:
        faults = ", ".join(f"{name} {change:+.0%}" for name, change in condition.faults.items())
        lines.append(f"| {condition.number} | {condition.name} | {faults} | {', '.join(own_equations(condition))} |")
    return [
        *lines,
        "",
        *_paragraph(
            "The paper's k11 holds bearing and shaft stiffness; here the bearing's own stiffness changes by 20 %,",
            "which is",
            "a part of k11. The paper's force direction is lost too; here one source acts on all six degrees of",
            "freedom",
            f"alike: S = ({', '.join(f'{value:.3g}' for value in study.direction)}) on (y1, y2, ψ, z1, z2, φ), the",
            "tilts",
            "through a lever arm of a third of the shaft. Equation 30 was given tilt probes; the likelihood and the",
            "amortised networks see only the machine's own channels. Only the noise realisation varies here, at known",
            "cutoffs; what the diagnosticians do when direction, level, cutoff and speed vary too stands in",
            "[results.md](results.md), and `rotortrain peers` puts the printed networks into that setting as well.",
        ),
        "",
    ]


def _text(rate: Rate) -> str:
    return f"{rate.rate:.0%} ({rate.low:.0%}-{rate.high:.0%})"


def _compared(shared: Rate, independent: Rate) -> str:
    """Whether two rates differ beyond their intervals."""
    if shared.low > independent.high:
        return "sharing the realisation flatters"
    if independent.low > shared.high:
        return "better on independent ones"
    return "no difference beyond chance"


def _locating(exact: Rate, found: Rate) -> str:
    if exact.low > 0.5:
        return "faults are noticed and located"
    return "faults are noticed, but seldom located" if found.low > 0.5 else "most faults go unnoticed"
