"""Verdict of a commissioning in sentences, and what to do next."""

from models.commissioning.report import CommissioningReport, ParameterSummary
from simulator.commission.units import change, duration, listed, percent

__all__ = ["VERDICT_TEXT", "budget_sentences", "dominant", "headline", "next_steps", "smallest_change"]

VERDICT_TEXT = {"commissioned": "commissioned", "limited": "commissioned with limits", "refused": "not commissioned"}
_ALIKE = 2.0
"""Errors add as squares: beside one twice as large, the other makes a tenth of the total."""
_MOST_OF_A_LOSS = 0.99
_MANY_TIMES = 10.0
_LONGEST_WINDOW_S = 3600.0
"""A machine file allows no longer one."""


def dominant(parameter: ParameterSummary) -> str:
    """Which error is nearly all of the total: ``commissioning``, ``window``, or ``both``; empty where there is none."""
    own, shared = parameter.window_error, parameter.commissioning_error
    if own is None or shared is None:
        return ""
    if shared > _ALIKE * own:
        return "commissioning"
    return "window" if own > _ALIKE * shared else "both"


def smallest_change(parameter: ParameterSummary) -> tuple[str, str]:
    """Smallest loss and gain that are found, in words; empty where there is none."""
    loss, gain = parameter.detectable_loss, parameter.detectable_gain
    if loss is None or gain is None:
        return "", ""
    return (
        change(loss) if loss > -_MOST_OF_A_LOSS else "not even all of it",
        change(gain) if gain < _MANY_TIMES else f"more than {_MANY_TIMES:g}-fold",
    )


def headline(report: CommissioningReport) -> str:
    """Verdict in one sentence."""
    place = f"{report.site}/{report.machine}"
    if report.verdict == "refused":
        reasons = [check.text for check in report.checks if check.verdict == "refused"] or [
            check.text for check in report.checks if check.verdict == "limited"
        ]
        return f"{place} is not commissioned: {'; '.join(reasons) or report.summary}."
    read = [parameter.name for parameter in report.parameters if parameter.evaluable]
    if read:
        told = f"changes of {listed(read)} can be told from the healthy state"
    else:
        told = "it can only be said that a channel has changed or has not, and no part of the machine is named"
    if report.verdict == "commissioned":
        return f"{place} is commissioned: {told}."
    limits = "; ".join(f"{check.name} ({check.text})" for check in report.checks if check.verdict == "limited")
    return f"{place} is commissioned with limits: {told}. What limits it: {limits or report.summary}."


def next_steps(report: CommissioningReport) -> tuple[str, ...]:
    """What to do next, most urgent first."""
    advice = tuple(
        dict.fromkeys(
            check.advice
            for verdict in ("refused", "limited")
            for check in report.checks
            if check.verdict == verdict and check.advice
        )
    )
    if report.verdict == "refused":
        return (*(_sentence(one) for one in advice), "Nothing was stored: the monitor cannot be started from this.")
    steps = [_sentence(one) for one in advice]
    steps.append("Start the monitor with the machine file and this folder: rotorwatch run --machine FILE@FOLDER.")
    short = [one.name for one in report.parameters if dominant(one) == "commissioning"]
    if short:
        steps.append(
            f"For sharper readings of {listed(short)}, commission again from more healthy data: what was learned is "
            "less certain than one window."
        )
    steps.append("Commission again after a repair, rebalancing or a change of sensors, and for other speeds or loads.")
    return tuple(steps)


def budget_sentences(report: CommissioningReport) -> tuple[str, ...]:
    """What limits the readings, and what a wished change takes."""
    read = [one for one in report.parameters if one.evaluable]
    if not read:
        return ()
    told = []
    if all(not one.commissioning_error for one in read):
        told.append(
            "The parameters in the machine file are taken as exact: no error of the commissioning is part of the "
            "intervals, and an error in the file reads as a change."
        )
    else:
        told.append(
            f"The {duration(report.healthy_s)} of healthy data leave an error of the commissioning. It is part of "
            "every later interval: longer windows do not remove it, more healthy data do."
        )
        for which, text in (
            ("commissioning", "The commissioning dominates the error of {}: record more healthy data."),
            ("window", "One window dominates the error of {}: a longer window helps, more healthy data little."),
            ("both", "Window and commissioning both count for {}: longer windows help, and so do more healthy data."),
        ):
            names = [one.name for one in read if dominant(one) == which]
            if names:
                told.append(text.format(listed(names)))
    found = [one for one in read if _found_already(one)]
    if found:
        sizes = {one.name: one.wished for one in found}
        told.append(f"{_wished(sizes)} of {listed(sizes)} is found as things are.")
    too_long = [one.name for one in read if (one.window_s_for_wished or 0.0) > _LONGEST_WINDOW_S]
    if too_long:
        told.append(
            f"For {listed(too_long)} the wished change would take a window of more than "
            f"{duration(_LONGEST_WINDOW_S)}, the longest there is: wish for a larger change, or measure with less "
            "noise."
        )
    return tuple(told)


def _found_already(parameter: ParameterSummary) -> bool:
    loss, gain, wished = parameter.detectable_loss, parameter.detectable_gain, parameter.wished
    return loss is not None and gain is not None and wished is not None and max(-loss, gain) <= wished


def _wished(sizes: dict[str, float | None]) -> str:
    return f"The wished change of {listed(percent(size) for size in sorted({s for s in sizes.values() if s}))}"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}"
