"""Verdict of a commissioning in sentences: no more digits than are known, units people use, and what to do next."""

import math
from collections.abc import Iterable

from models.commissioning.commission import CommissioningReport, ParameterSummary
from models.diagnosis.baseline.rows import PLACES
from models.levels.limits import MEASURE_WORDS

_PLACES = PLACES | {
    "psi": "disc tilt, horizontal",
    "phi": "disc tilt, vertical",
    "theta": "shaft angle (phase reference)",
}
_ENDINGS = {"": "displacement", "dot": "velocity", "ddot": "acceleration"}
_TILT_ENDINGS = {"": "angle", "dot": "rate", "ddot": "acceleration"}
_UNITS = {"": ("µm", 1e6), "dot": ("mm/s", 1e3), "ddot": ("m/s²", 1.0)}
_TILT_UNITS = {"": ("mrad", 1e3), "dot": ("mrad/s", 1e3), "ddot": ("rad/s²", 1.0)}
_VALUE_UNITS = {"k": "N/m", "c": "N s/m", "e": "m", "EI": "Pa"}
_PREFIXES = ((1e9, "G"), (1e6, "M"), (1e3, "k"), (1.0, ""), (1e-3, "m"), (1e-6, "µ"), (1e-9, "n"))


def significant(value: float, digits: int = 2) -> str:
    """Round to significant digits, without an exponent.

    Examples
    --------
    >>> [significant(x) for x in (0.0108, 1.96, 9.96, 2043.9)]
    ['0.011', '2.0', '10', '2000']
    """
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    rounded = float(f"{value:.{digits - 1}e}")
    decimals = digits - 1 - math.floor(math.log10(abs(rounded)))
    return f"{rounded:.{max(0, decimals)}f}"


def percent(value: float) -> str:
    """Ratio in percent, with two significant digits.

    Examples
    --------
    >>> [percent(x) for x in (0.0108, 0.11022, 2.06, 0.0)]
    ['1.1%', '11%', '210%', '0%']
    """
    return f"{significant(100 * value)}%"


def change(value: float) -> str:
    """Relative change with its sign.

    Examples
    --------
    >>> [change(x) for x in (-0.1008, 0.112)]
    ['−10%', '+11%']
    """
    return f"{'−' if value < 0 else '+'}{percent(abs(value))}"


def duration(seconds: float) -> str:
    """Length of time in the unit that fits it.

    Examples
    --------
    >>> [duration(x) for x in (15, 27.5, 165.8, 300, 3830, 20000, 1e6)]
    ['15 s', '28 s', '2.8 min', '5 min', '64 min', '5.6 h', '12 days']
    """
    for limit, unit_s, unit in ((120, 1, "s"), (7200, 60, "min"), (48 * 3600, 3600, "h")):
        if seconds < limit:
            return f"{_short(seconds / unit_s, 3 if seconds / unit_s >= 100 else 2)} {unit}"
    return f"{_short(seconds / 86400)} days"


def _short(value: float, digits: int = 2) -> str:
    text = significant(value, digits)
    return text.rstrip("0").rstrip(".") if "." in text else text


def parameter_value(name: str, value: float) -> str:
    """Value of a parameter with its unit.

    Examples
    --------
    >>> parameter_value("k_by", 49945.5), parameter_value("e", 1.9977e-5), parameter_value("c_bz", 59.66)
    ('49.9 kN/m', '20.0 µm', '59.7 N s/m')
    >>> parameter_value("EI", 2.1e11)
    'E = 210 GPa'
    """
    unit = _VALUE_UNITS.get(name) or _VALUE_UNITS[name.partition("_")[0]]
    factor, prefix = next(((f, p) for f, p in _PREFIXES if abs(value) >= f), (1.0, ""))
    symbol = "E = " if name == "EI" else ""  # the shaft's stiffness is carried by its modulus
    return f"{symbol}{significant(value / factor, 3)} {prefix}{unit}"


def channel_text(state: str) -> str:
    """What a state variable measures.

    Examples
    --------
    >>> channel_text("y1"), channel_text("z2_dot"), channel_text("psi_dot")
    ('bearing, horizontal, displacement', 'disc, vertical, velocity', 'disc tilt, horizontal, rate')
    >>> channel_text("bearing@45_dot")
    'bearing, at 45°, velocity'
    """
    place, _, ending = state.partition("_")
    location, at, angle_deg = place.partition("@")
    if at:
        return f"{location}, at {angle_deg}°, {_ENDINGS[ending]}"
    if place == "theta" or place not in _PLACES:
        return _PLACES.get(place, state)
    return f"{_PLACES[place]}, {(_TILT_ENDINGS if place in ('psi', 'phi') else _ENDINGS)[ending]}"


def channel_unit(state: str) -> tuple[str, float]:
    """Unit in which a state is shown, and the factor from SI to it."""
    place, _, ending = state.partition("_")
    return (_TILT_UNITS if place in ("psi", "phi") else _UNITS)[ending]


def listed(words: Iterable[str]) -> str:
    """Join words as a sentence does.

    Examples
    --------
    >>> listed(["k_by", "c_by", "e"])
    'k_by, c_by and e'
    """
    *most, last = list(words) or [""]
    return f"{', '.join(most)} and {last}" if most else last


VERDICT_TEXT = {"commissioned": "commissioned", "limited": "commissioned with limits", "refused": "not commissioned"}
_ALIKE = 2.0  # errors add as squares: one half as large as the other contributes a tenth of the total
_MOST_OF_A_LOSS = 0.99
_MANY_TIMES = 10.0
_LONGEST_WINDOW_S = 3600.0  # a machine file allows no longer one


def dominant(parameter: ParameterSummary) -> str:
    """Which error makes nearly all of the total: ``commissioning``, ``window``, or ``both``; empty if not known."""
    own, shared = parameter.window_error, parameter.commissioning_error
    if own is None or shared is None:
        return ""
    if shared > _ALIKE * own:
        return "commissioning"
    return "window" if own > _ALIKE * shared else "both"


def smallest_change(parameter: ParameterSummary) -> tuple[str, str]:
    """Smallest loss and gain that are detected, in words; empty if not known."""
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
        refused, limited = ([c.text for c in report.checks if c.verdict == each] for each in ("refused", "limited"))
        reasons = refused or limited
        return f"{place} is not commissioned: {'; '.join(reasons) or report.summary}."
    read = [parameter.name for parameter in report.parameters if parameter.evaluable]
    if read:
        told = f"changes of {listed(read)} can be told from the healthy state"
    elif report.conditions is None or report.conditions.rms:
        told = "it can only be said that a channel has changed or has not, and no part of the machine is named"
    else:
        than = "first windows that the monitor sees" if not report.levels else "healthy recordings"
        told = f"the vibration levels of its channels are compared with those of the {than}, and no part is diagnosed"
    if report.verdict == "commissioned":
        return f"{place} is commissioned: {told}."
    limits = "; ".join(f"{check.name} ({check.text})" for check in report.checks if check.verdict == "limited")
    return f"{place} is commissioned with limits: {told}. What limits it: {limits or report.summary}."


def next_steps(report: CommissioningReport) -> tuple[str, ...]:
    """What to do next, most urgent first."""
    ordered = sorted(report.checks, key=lambda check: check.verdict != "refused")
    advice = dict.fromkeys(check.advice for check in ordered if check.verdict != "passed" and check.advice)
    steps = [f"{text[:1].upper()}{text[1:]}{'' if text.endswith('.') else '.'}" for text in advice]
    if report.verdict == "refused":
        return (*steps, "Nothing was stored: the monitor cannot be started from this.")
    steps.append("Start the monitor with the machine file and this bundle: rotorwatch run --machine FILE@BUNDLE.")
    short = [one.name for one in report.parameters if dominant(one) == "commissioning"]
    if short:
        steps.append(
            f"For sharper readings of {listed(short)}, commission again from more healthy data: what was learned is "
            "less certain than one window."
        )
    steps.append("Commission again after a repair, rebalancing or a change of sensors, and for other speeds or loads.")
    return tuple(steps)


def budget_sentences(report: CommissioningReport) -> tuple[str, ...]:
    """What limits the readings, and whether the wished changes can be detected."""
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
            "every later interval: longer windows do not remove it, but more healthy data do."
        )
        for which, text in (
            ("commissioning", "The commissioning dominates the error of {}: record more healthy data."),
            ("window", "One window dominates the error of {}: a longer window helps, more healthy data help little."),
            ("both", "Window and commissioning both contribute to {}: longer windows and more healthy data help."),
        ):
            names = [one.name for one in read if dominant(one) == which]
            if names:
                told.append(text.format(listed(names)))
    sizes = {}
    for one in read:
        loss, gain, size = one.detectable_loss, one.detectable_gain, one.wished
        if loss is not None and gain is not None and size is not None and max(-loss, gain) <= size:
            sizes[one.name] = size
    if sizes:
        wished = listed(percent(size) for size in sorted({size for size in sizes.values() if size}))
        told.append(f"The wished change of {wished} of {listed(sizes)} is found with the present settings.")
    never = [one.name for one in read if one.wished is not None and one.window_s_for_wished is None]
    if never:
        told.append(
            f"For {listed(never)} the wished change is never found with 95 % probability, however long the windows and "
            "the recordings: commission in more conditions, or wish for a larger change."
        )
    too_long = [one.name for one in read if (one.window_s_for_wished or 0.0) > _LONGEST_WINDOW_S]
    if too_long:
        told.append(
            f"For {listed(too_long)} the wished change would take a window of more than "
            f"{duration(_LONGEST_WINDOW_S)}, the longest there is: wish for a larger change, or measure with less "
            "noise."
        )
    return tuple(told)


def growth_sentence(report: CommissioningReport) -> str:
    """Least and largest growth of a level that raises an alert, in words; empty if no level has such a limit."""
    found = [(one.growth, one) for one in report.levels if one.growth is not None]
    if not found:
        return ""
    (least, first), (most, last) = (edge(found, key=lambda each: each[0]) for edge in (min, max))
    low, high = f"{100 * least:.0f}%", f"{100 * most:.0f}%"
    at_least, at_most = (f"{one.channel} {MEASURE_WORDS[one.measure]}" for one in (first, last))
    ends = f"{low} ({at_least}) to {high} ({at_most})"
    return (
        "A level raises an alert, relative to the healthy machine, once it has grown by "
        f"{low if low == high else ends}. A load that is not in the recordings, stronger or from another direction, "
        "makes some channels louder as well and raises alerts."
    )
