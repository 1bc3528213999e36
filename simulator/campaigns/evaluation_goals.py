"""The declared goals, and what was measured of each: computed from the summaries, never typed in."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from models.diagnosis.readings import Z95
from models.diagnosis.verdict.calibration import window_thresholds
from models.diagnosis.verdict.stretch import to_scale
from models.physics.parameters import PARAMETERS
from simulator.campaigns.evaluation import RATES
from simulator.campaigns.evaluation_cells import Topic
from simulator.campaigns.evaluation_summary import (
    CellSummary,
    Interval,
    OpinionSummary,
    ParameterSummary,
    Summary,
    pooled,
)
from simulator.campaigns.rates import Rate
from simulator.training.draws import Anomaly, Excitation, Layout

__all__ = [
    "LAYOUT_TEXT",
    "Goal",
    "anomaly_text",
    "excitation_text",
    "goals",
    "length_exponent",
    "percent",
    "rate_text",
]

LAYOUT_TEXT = {Layout.ONE_SOURCE: "one source", Layout.INDEPENDENT: "independent sources"}

_EXCITATION_TEXT = {
    Excitation.SECOND_ORDER: "second-order low-pass (assumed)",
    Excitation.FIRST_ORDER: "first-order low-pass",
    Excitation.FOURTH_ORDER: "fourth-order low-pass",
    Excitation.OWN_CUTOFFS: "a cutoff for every source",
    Excitation.HUMP: "hump at 40–120 Hz",
    Excitation.DRIFT: "level doubles or halves",
}
_ANOMALY_TEXT = {
    Anomaly.NONE: "nothing",
    Anomaly.CRACK: "breathing crack",
    Anomaly.RUB: "rub",
    Anomaly.ADDED_MASS: "deposit on the disc",
    Anomaly.GAIN_DRIFT: "gain of a sensor",
}
_READ = ("k_by", "c_by", "k_bz", "c_bz", "e")
_COVERED = (0.93, 0.97)
_DETECTED = {
    "likelihood": (
        ("k_by", -0.02, 0.99),
        ("c_bz", -0.10, 0.99),
        ("e", 0.10, 0.99),
        ("c_by", -0.05, 0.60),
        ("e", 0.05, 0.80),
    ),
    "network": (("k_bz", -0.05, 0.99), ("c_by", -0.20, 0.99), ("c_bz", -0.20, 0.99), ("e", 0.20, 0.99)),
}
_EXACT = {"likelihood": 0.99, "network": 0.95}
_IN_BOUNDS = {
    "lab": {
        "likelihood": {"k_by": 1.15, "c_by": 1.15, "k_bz": 1.15, "c_bz": 1.15, "e": 1.15},
        "network": {"k_by": 2.0, "k_bz": 2.0, "c_by": 1.5, "c_bz": 1.5},
    },
    "light": {"likelihood": {"k_by": 1.3, "c_by": 1.3, "k_bz": 1.3, "c_bz": 1.3, "e": 1.3}},
}
_ONE_SOURCE = {"k_by": 0.0008, "k_bz": 0.0008, "c_by": 0.003, "c_bz": 0.003}


@dataclass(frozen=True, slots=True)
class Goal:
    """One declared goal.

    Attributes
    ----------
    machine, what, declared, measured : str
    met : bool or None
        None where the evaluation holds nothing to judge it by.
    certain : bool
        Whether the 95 % interval of the measured figure lies on one side of the goal.
    """

    machine: str
    what: str
    declared: str
    measured: str
    met: bool | None
    certain: bool = True

    @property
    def verdict(self) -> str:
        """In words."""
        if self.met is None:
            return "not measured" if self.measured == "–" else "–"
        return ("yes" if self.met else "**no**") + ("" if self.certain else ", within chance")


def percent(value: float, digits: int = 1) -> str:
    """A share or a relative change in percent."""
    return f"{100 * value:.{digits}f} %"


def rate_text(rate: Rate | None) -> str:
    """A rate with its interval and its windows."""
    if rate is None:
        return "–"
    return f"{100 * rate.rate:.3g} % ({100 * rate.low:.3g}–{100 * rate.high:.3g}, {rate.count} of {rate.of})"


def goals(summary: Summary) -> list[Goal]:
    """All goals of one machine, in the order in which they are shown; those of absent diagnosticians are left out."""
    asked = [by for by in ("likelihood", "network") if by in summary.diagnosticians]
    found: list[Goal] = []
    if summary.campaign.machine == "lab":
        for by in asked:
            found += _detection(summary, by)
    for by in asked:
        found += _bounds(summary, by)
    if summary.campaign.machine == "lab":
        found += _one_source(summary)
    for by in asked:
        found += [*_false_alarms(summary, by), *_coverage(summary, by)]
    found += _power(summary)
    if summary.campaign.full:
        found += [*_excitation(summary), *_length(summary), *_outside(summary)]
    if "network" in asked:
        found += _cost(summary)
    return found


def _detection(summary: Summary, by: str) -> Iterator[Goal]:
    for layout in Layout:
        for name, truth, least in _DETECTED[by]:
            cells = [
                cell
                for cell in summary.of(Topic.SMALL, Topic.PAPER, layout=layout)
                if cell.truth is not None and cell.truth.get(name) == truth
            ]
            # Alone, where that was measured: beside another change a further one needs stronger evidence.
            alone = [cell for cell in cells if len(cell.truth or {}) == 1]
            cells = alone or [cell for cell in cells if cell.topic is Topic.SMALL]
            rate = pooled(one.found[0] for _, one in _read(cells, by, name))
            goal = _at_least(
                summary, f"{by}: {name} {truth:+.0%} detected at 1 % false alarms, {LAYOUT_TEXT[layout]}", rate, least
            )
            possible = _found_at_bound(summary, layout, name, truth)
            at_bound = "" if possible is None else f"; at the bound {percent(possible)}"
            yield replace(goal, measured=goal.measured + at_bound)
    for layout in Layout:
        opinions = [cell.opinions[by] for cell in summary.of(Topic.PAPER, layout=layout) if by in cell.opinions]
        text = f"the paper's conditions, {LAYOUT_TEXT[layout]}"
        exact = pooled(one.exact[0] for one in opinions)
        yield _at_least(summary, f"{by}: exactly the changed parameters named, {text}", exact, _EXACT[by])
        if by == "likelihood":
            wrong = pooled(one.wrong[0] for one in opinions)
            yield _at_most(summary, f"{by}: a parameter named that did not change, {text}", wrong, 0.005)


def _found_at_bound(summary: Summary, layout: Layout, name: str, truth: float) -> float | None:
    """Share of windows in which a normal reading with the bound's standard error would cross the same threshold.

    Over the conditions of the healthy windows, which are drawn as those of the changed ones are.
    """
    read = [one for _, one in _read(summary.of(Topic.HEALTHY, layout=layout), "likelihood", name)]
    bounds = np.array([bound for one in read for bound in one.bound_quantiles])
    if not bounds.size:
        return None
    threshold = window_thresholds(RATES[0], len(PARAMETERS)).first
    z = abs(to_scale(name, truth)) / bounds
    return float(np.mean(ndtr(z - threshold) + ndtr(-z - threshold)))


def _bounds(summary: Summary, by: str) -> Iterator[Goal]:
    limits = _IN_BOUNDS.get(summary.campaign.machine, {}).get(by, {})
    healthy = summary.of(Topic.HEALTHY, layout=Layout.INDEPENDENT)
    for name, limit in limits.items():
        ratios = [one.spread_in_bounds for _, one in _read(healthy, by, name) if one.spread_in_bounds is not None]
        yield _ratio(summary, f"{by}: spread of {name}, independent sources", ratios, limit)


def _one_source(summary: Summary) -> Iterator[Goal]:
    healthy = summary.of(Topic.HEALTHY, layout=Layout.ONE_SOURCE)
    for name, limit in _ONE_SOURCE.items():
        what, declared = f"likelihood: spread of {name}, one source", f"≤ {percent(limit, 2)}"
        for _, one in _read(healthy, "likelihood", name):
            if one.spread is not None:
                low, high = one.spread.low, one.spread.high
                text = f"{percent(one.spread.value, 3)} ({100 * low:.3f}–{100 * high:.3f})"
                met, certain = one.spread.value <= limit, not low <= limit <= high
                yield Goal(summary.campaign.machine, what, declared, text, met, certain)


def _false_alarms(summary: Summary, by: str) -> Iterator[Goal]:
    opinions = [cell.opinions[by] for cell in summary.of(Topic.HEALTHY) if by in cell.opinions]
    for at, declared in enumerate(RATES):
        rate = pooled(one.any_named[at] for one in opinions)
        met = None if rate is None else rate.low <= declared <= rate.high
        yield Goal(
            summary.campaign.machine,
            f"{by}: false alarms of a healthy window, both layouts",
            f"{percent(declared)} inside the interval",
            rate_text(rate),
            met,
        )


def _coverage(summary: Summary, by: str) -> Iterator[Goal]:
    for layout in Layout:
        for text, topics in (("healthy", (Topic.HEALTHY,)), ("changed", (Topic.SMALL, Topic.PAPER))):
            cells = summary.of(*topics, layout=layout)
            covered = {name: pooled(one.covered for _, one in _read(cells, by, name)) for name in (*_READ, "EI")}
            rates = {name: rate for name, rate in covered.items() if rate is not None}
            what = f"{by}: 95 % intervals cover, every parameter, {text} windows, {LAYOUT_TEXT[layout]}"
            yield _within(summary, what, rates, _COVERED)


def _power(summary: Summary) -> Iterator[Goal]:
    cells = summary.of(Topic.DETECTABLE)
    if cells:
        rate = pooled(
            one.found[0]
            for cell in cells
            if "likelihood" in cell.opinions
            for one in cell.opinions["likelihood"].parameters
            if one.found
        )
        what = "likelihood: detected at the quoted minimum detectable change"
        yield _within(summary, what, {} if rate is None else {"all": rate}, (0.92, 0.98))


def _excitation(summary: Summary) -> Iterator[Goal]:
    cells = summary.of(Topic.EXCITATION)
    for layout in Layout:
        of_layout = [cell for cell in cells if cell.layout == layout]
        where = f"excitation untold, {LAYOUT_TEXT[layout]}"
        each = [(cell, one) for name in _READ for cell, one in _read(of_layout, "likelihood", name)]
        covered = {f"{one.name}, {excitation_text(cell.excitation)}": one.covered for cell, one in each}
        yield _within(summary, f"likelihood: 95 % intervals cover, {where}", covered, _COVERED)
        for what, declared, limit, values in (
            ("bias", "≤ 0.5 standard errors", 0.5, [(c, o, _absolute(o.bias_in_errors)) for c, o in each]),
            ("spread", "≤ 1.5 × stated error", 1.5, [(c, o, o.spread_in_errors) for c, o in each]),
        ):
            known = [(cell, one, value) for cell, one, value in values if value is not None]
            if not known:
                yield Goal(summary.campaign.machine, f"likelihood: {what}, {where}", declared, "–", None)
                continue
            cell, one, worst = max(known, key=lambda entry: entry[2].value)
            at = f"{one.name}, {excitation_text(cell.excitation)}"
            yield Goal(
                summary.campaign.machine,
                f"likelihood: {what} of every parameter, {where}",
                declared,
                f"worst {worst.value:.2f} ({worst.low:.2f}–{worst.high:.2f}): {at}",
                worst.value <= limit,
                not worst.low <= limit <= worst.high,
            )


def _length(summary: Summary) -> Iterator[Goal]:
    for layout in Layout:
        fitted = {}
        for name in _READ:
            exponent = length_exponent(summary, layout, name)
            if exponent is not None:
                fitted[name] = exponent
        what = f"likelihood: spread falls as 1/√T, every parameter, {LAYOUT_TEXT[layout]}"
        declared = "exponent −0.5 ± 0.1"
        if not fitted:
            yield Goal(summary.campaign.machine, what, declared, "–", None)
            continue
        name, worst = max(fitted.items(), key=lambda entry: abs(entry[1].value + 0.5))
        yield Goal(
            summary.campaign.machine,
            what,
            declared,
            f"farthest off {worst.value:.2f} ({worst.low:.2f} to {worst.high:.2f}): {name}",
            abs(worst.value + 0.5) <= 0.1,
            not any(worst.low <= limit <= worst.high for limit in (-0.6, -0.4)),
        )


def length_exponent(summary: Summary, layout: Layout, name: str) -> Interval | None:
    """Exponent of the window length in the likelihood's spread.

    Fitted to the spread over the bound, which is itself proportional to 1/√T, so that windows of different conditions
    can be compared. None with fewer than three lengths.
    """
    cells = summary.of(Topic.LENGTH, Topic.HEALTHY, layout=layout)
    points = [
        (cell.length_s, one.spread_in_bounds)
        for cell, one in _read(cells, "likelihood", name)
        if one.spread_in_bounds is not None and one.spread_in_bounds.low > 0
    ]
    if len({length_s for length_s, _ in points}) < 3:
        return None
    x = np.log([length_s for length_s, _ in points])
    y = np.log([ratio.value for _, ratio in points])
    weight = np.array([(2 * Z95 / np.log(ratio.high / ratio.low)) ** 2 for _, ratio in points])
    x = x - np.average(x, weights=weight)
    precision = float(np.sum(weight * x**2))
    slope = float(np.sum(weight * x * y)) / precision - 0.5
    half = Z95 / precision**0.5
    return Interval(value=slope, low=slope - half, high=slope + half)


def _outside(summary: Summary) -> Iterator[Goal]:
    cells = summary.of(Topic.OUTSIDE)
    for anomaly in sorted({cell.anomaly for cell in cells}):
        opinions = [c.opinions["likelihood"] for c in cells if c.anomaly == anomaly and "likelihood" in c.opinions]
        refused = sum(one.refused for one in opinions)
        noticed = pooled(one.noticed[0] for one in opinions)
        yield Goal(
            summary.campaign.machine,
            f"likelihood: {anomaly_text(anomaly)}: flagged as outside the model, or a suspect named",
            "no figure declared",
            rate_text(noticed) + (f"; {refused} more refused as not evaluable" if refused else ""),
            None,
        )
        what = f"likelihood: {anomaly_text(anomaly)}: bearing or unbalance claimed, window not flagged"
        yield _at_most(summary, what, pooled(one.claimed[0] for one in opinions), 0.05)


def _cost(summary: Summary) -> Iterator[Goal]:
    values = [cell.opinions["network"].milliseconds for cell in summary.cells if "network" in cell.opinions]
    if values:
        slowest = max(values)
        what = "network: processor time of a window, median of the slowest cell"
        yield Goal(summary.campaign.machine, what, "≤ 1 ms", f"{slowest:.2g} ms", slowest <= 1.0)


def _read(cells: Sequence[CellSummary], by: str, name: str) -> Iterator[tuple[CellSummary, ParameterSummary]]:
    for cell in cells:
        opinion: OpinionSummary | None = cell.opinions.get(by)
        one = None if opinion is None else opinion.parameter(name)
        if one is not None:
            yield cell, one


def excitation_text(excitation: Excitation) -> str:
    """What the stochastic force looks like, in words."""
    return _EXCITATION_TEXT[excitation]


def anomaly_text(anomaly: Anomaly) -> str:
    """A fault that no parameter describes, in words."""
    return _ANOMALY_TEXT[anomaly]


def _absolute(interval: Interval) -> Interval:
    if interval.low >= 0:
        return interval
    low, high = sorted((abs(interval.low), abs(interval.high)))
    return Interval(value=abs(interval.value), low=low if interval.high < 0 else 0.0, high=high)


def _at_least(summary: Summary, what: str, rate: Rate | None, least: float) -> Goal:
    met = None if rate is None else rate.rate >= least
    certain = rate is None or not rate.low < least <= rate.high
    return Goal(summary.campaign.machine, what, f"≥ {100 * least:g} %", rate_text(rate), met, certain)


def _at_most(summary: Summary, what: str, rate: Rate | None, most: float) -> Goal:
    met = None if rate is None else rate.rate <= most
    certain = rate is None or not rate.low <= most < rate.high
    return Goal(summary.campaign.machine, what, f"≤ {100 * most:g} %", rate_text(rate), met, certain)


def _within(summary: Summary, what: str, rates: dict[str, Rate], limits: tuple[float, float]) -> Goal:
    """Every one of several rates between two limits; the one farthest off is shown."""
    low, high = limits
    declared = f"{100 * low:g} to {100 * high:g} %"
    if not rates:
        return Goal(summary.campaign.machine, what, declared, "–", None)
    name, worst = max(rates.items(), key=lambda entry: abs(entry[1].rate - (low + high) / 2))
    inside = sum(low <= rate.rate <= high for rate in rates.values())
    text = (
        rate_text(worst) if len(rates) == 1 else f"{inside} of {len(rates)} inside; farthest {name} {rate_text(worst)}"
    )
    met = inside == len(rates)
    certain = all(low <= rate.low and rate.high <= high for rate in rates.values())
    if not met:
        certain = any(rate.high < low or rate.low > high for rate in rates.values())
    return Goal(summary.campaign.machine, what, declared, text, met, certain)


def _ratio(summary: Summary, what: str, ratios: Sequence[Interval], limit: float) -> Goal:
    declared = f"≤ {limit:g} × bound"
    if not ratios:
        return Goal(summary.campaign.machine, what, declared, "–", None)
    worst = max(ratios, key=lambda one: one.value)
    text = f"{worst.value:.2f} ({worst.low:.2f}–{worst.high:.2f}) × bound"
    return Goal(
        summary.campaign.machine, what, declared, text, worst.value <= limit, not worst.low <= limit <= worst.high
    )
