"""Computes figures from records: groups, rates and spreads with 95 % intervals, and goals judged by them.

The spread is a robust standard deviation, 1.4826 times the median absolute deviation from the median. Intervals of
rates are Clopper-Pearson intervals; all others are bootstrap intervals over windows.
"""

import csv
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import scipy.stats

from models.diagnosis.readings import Z95
from models.errors import EstimationError

Value = str | float | bool | None  # value in a record: any JSON value that is not nested
Record = Mapping[str, Value]
FloatArray = npt.NDArray[np.float64]
_T = TypeVar("_T")
Of = Callable[[Sequence[Record]], _T]  # function from records to a figure

_RESAMPLINGS = 400
_RESAMPLING_SEED = 20261
_FEWEST = 4  # least number of windows for a spread


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure with its 95 % interval."""

    value: float
    low: float
    high: float
    n: int  # windows
    count: int | None = None  # for a rate, the number of windows in which it holds

    def __str__(self) -> str:
        if self.count is None:
            return f"{self.value:.3g} ({self.low:.3g}–{self.high:.3g})"
        return f"{100 * self.value:.3g} % ({100 * self.low:.3g}–{100 * self.high:.3g}, {self.count} of {self.n})"


def rate(flags: Iterable[object]) -> Estimate | None:
    """Fraction of true flags, with its Clopper-Pearson interval for independent windows; None without windows."""
    held = [bool(flag) for flag in flags]
    return _share(sum(held), len(held), 0.025) if held else None


def _share(count: int, n: int, tail: float) -> Estimate:
    low = 0.0 if count == 0 else float(scipy.stats.beta.ppf(tail, count, n - count + 1))
    high = 1.0 if count == n else float(scipy.stats.beta.ppf(1 - tail, count + 1, n - count))
    return Estimate(count / n, low, high, n, count)


def resampled(statistic: Callable[[FloatArray], FloatArray], values: FloatArray) -> Estimate:
    """A statistic over the last axis with its bootstrap interval; the seed is fixed, so results are reproducible."""
    rng = np.random.default_rng(_RESAMPLING_SEED)
    drawn = statistic(values[rng.integers(len(values), size=(_RESAMPLINGS, len(values)))])
    low, high = np.quantile(drawn, (0.025, 0.975)).tolist()
    return Estimate(float(statistic(values)), low, high, len(values))


def rms(values: FloatArray) -> FloatArray:
    """Root mean square over the last axis."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=-1)), dtype=np.float64)


def robust(values: FloatArray) -> FloatArray:
    """1.4826 times the median absolute deviation from the median, over the last axis."""
    middle = np.median(values, axis=-1, keepdims=True)
    return np.asarray(1.4826 * np.median(np.abs(values - middle), axis=-1), dtype=np.float64)


def floats(values: Iterable[Value]) -> FloatArray:
    """All values that are numbers or booleans."""
    return np.array([value for value in values if value is not None and not isinstance(value, str)], dtype=np.float64)


def limit_of(healthy: FloatArray, false_alarm_rate: float) -> float:
    """Limit that a further healthy window exceeds with at most the declared probability, for any distribution.

    It is the ⌈(n+1)(1-α)⌉-th smallest of n healthy scores not used for learning. Raises EstimationError with fewer than
    1/α - 1 scores.
    """
    rank = int(np.ceil((healthy.size + 1) * (1 - false_alarm_rate) - 1e-9))
    if rank > healthy.size:
        fewest = int(np.ceil(1 / false_alarm_rate - 1e-9)) - 1
        raise EstimationError(
            f"{healthy.size} healthy scores for a rate of {false_alarm_rate:g}, expected at least {fewest}"
        )
    return float(np.sort(healthy)[rank - 1])


def limits_of(healthy: Sequence[Mapping[str, float]], false_alarm_rate: float) -> dict[str, float]:
    """Limits of several test values, any of which a further healthy window exceeds with the declared probability.

    Each value is scaled by its own 90 % quantile, so that none dominates the limits of the others. An upper quantile is
    used instead of the median because operating conditions make some values many times larger than the rest.
    """
    names = sorted({name for one in healthy for name in one})
    scale = {name: float(np.quantile([one[name] for one in healthy if name in one], 0.9)) for name in names}
    largest = [max((value / scale[name] for name, value in one.items()), default=0.0) for one in healthy]
    limit = limit_of(np.array(largest), false_alarm_rate) * (1 + 1e-12)  # not exceeded by the window that sets it
    return {name: limit * one for name, one in scale.items()}


def grouped(records: Iterable[Record], *by: str) -> dict[tuple[Value, ...], list[Record]]:
    """Records grouped by the values of some columns, in order of first occurrence."""
    groups: dict[tuple[Value, ...], list[Record]] = {}
    for record in records:
        groups.setdefault(tuple(record[name] for name in by), []).append(record)
    return groups


def where(records: Iterable[Record], **wanted: Value | tuple[Value, ...]) -> list[Record]:
    """Records with the given values; for a tuple, with any of its values."""
    one_of = {name: value if isinstance(value, tuple) else (value,) for name, value in wanted.items()}
    return [record for record in records if all(record.get(name) in values for name, values in one_of.items())]


def among(figure: Of[_T], **wanted: Value | tuple[Value, ...]) -> Of[_T]:
    """A figure computed only from the records with the given values."""
    return lambda rows: figure(where(rows, **wanted))


def share(column: str) -> Of[Estimate | None]:
    """Rate at which a column is true, among records that have it."""
    return lambda rows: rate(row[column] for row in rows if row.get(column) is not None)


def statistic(column: str, make: Callable[[FloatArray], float | FloatArray]) -> Of[float | None]:
    """A statistic of the numbers in a column; None without numbers."""

    def of(rows: Sequence[Record]) -> float | None:
        found = floats(row.get(column) for row in rows)
        return float(make(found)) if found.size else None

    return of


def middle(column: str) -> Of[float | None]:
    """Median of a column."""
    return statistic(column, np.median)


def estimated(column: str, make: Callable[[FloatArray], FloatArray], fewest: int) -> Of[Estimate | None]:
    """A statistic of a column with its interval; None with fewer than `fewest` numbers."""

    def of(rows: Sequence[Record]) -> Estimate | None:
        found = floats(row.get(column) for row in rows)
        return resampled(make, found) if found.size >= fewest else None

    return of


def scatter(column: str) -> Of[Estimate | None]:
    """Spread of a column."""
    return estimated(column, robust, _FEWEST)


def each(records: Iterable[Record], by: Sequence[str], figure: Of[Estimate | None]) -> dict[str, Estimate | None]:
    """A figure of every group, by the values that define it."""
    return {", ".join(map(str, key)): figure(group) for key, group in grouped(records, *by).items()}


Figure = Estimate | float | str | None


@dataclass(frozen=True, slots=True)
class Table:
    """A table of results: one row for every group of records."""

    name: str  # name of the CSV file
    by: tuple[str, ...]
    columns: Mapping[str, Of[Figure]]
    rows: Callable[[Sequence[Record]], Iterable[Record]] = field(default=lambda records: records)
    """Function from records to the rows to be grouped: the records, or one row for each parameter."""
    page: str = ""  # text above the table on the page; if empty, it is only in its file

    def of(self, records: Sequence[Record]) -> list[dict[str, Figure]]:
        """Rows of the table."""
        rows: list[dict[str, Figure]] = []
        for key, group in grouped(self.rows(records), *self.by).items():
            figures = {name: of(group) for name, of in self.columns.items()}
            rows.append({**dict(zip(self.by, key, strict=True)), **figures})
        return rows

    def write(self, records: Sequence[Record], folder: Path) -> Path:
        """Write the table as CSV; an estimate has four columns: value, ends of the 95 % interval, windows."""
        path = folder / f"{self.name}.csv"
        rows = [{k: v for name, value in row.items() for k, v in _cells(name, value)} for row in self.of(records)]
        heads = list(dict.fromkeys(name for row in rows for name in row))
        with path.open("w", encoding="utf-8", newline="") as out:
            writer = csv.DictWriter(out, heads, lineterminator="\n")
            writer.writeheader()
            writer.writerows(rows)
        return path


def _cells(name: str, value: Figure) -> list[tuple[str, Value]]:
    if isinstance(value, Estimate):
        parts = {"": value.value, " low": value.low, " high": value.high, " windows": value.n}
        return [(f"{name}{part}", f"{figure:.5g}") for part, figure in parts.items()]
    return [(name, f"{value:.5g}" if isinstance(value, float) else value)]


@dataclass(frozen=True, slots=True)
class Goal:
    """A declared goal, and the measured result."""

    what: str
    declared: str
    measured: str
    verdict: str  # ``met``; ``missed``: the whole interval is outside; ``within chance``: only the figure is; or ``–``


def at_least(what: str, measured: Estimate | None, least: float, declared: str = "") -> Goal:
    """Goal that a rate is not below a limit."""
    goal = within(what, {"": measured}, least, 1.0)
    return replace(goal, declared=declared) if declared else goal


def at_most(what: str, measured: Estimate | None, most: float) -> Goal:
    """Goal that a figure is not above a limit."""
    return within(what, {"": measured}, 0.0, most)


def within(what: str, figures: Mapping[str, Estimate | None], low: float, high: float) -> Goal:
    """Goal that one or several figures all lie between two limits; the worst is shown.

    Their intervals are widened for simultaneous coverage, because some of many lie outside by chance.
    """
    found = {name: one for name, one in figures.items() if one is not None}
    if not found:
        return Goal(what, "", "–", "–")
    are_rates = all(one.count is not None for one in found.values())
    best = low if low == 0 else high if high >= 1 and are_rates else (low + high) / 2
    name = max(found, key=lambda name: abs(found[name].value - best))
    verdicts = [_verdict(one, _together(one, len(found)), low, high) for one in found.values()]
    verdict = next((one for one in ("missed", "within chance") if one in verdicts), "met")
    several = f"{verdicts.count('met')} of {len(found)} inside; worst {name}: " if len(found) > 1 else ""
    declared = f"{_limit(found[name], low)} to {_limit(found[name], high)}"
    if low == 0 or (high >= 1 and found[name].count is not None):
        declared = f"≤ {_limit(found[name], high)}" if low == 0 else f"≥ {_limit(found[name], low)}"
    return Goal(what, declared, f"{several}{found[name]}", verdict)


def _together(one: Estimate, figures: int) -> Estimate:
    """Widen an interval so that those of all `figures` figures jointly have 95 % coverage (Bonferroni)."""
    if one.count is not None:
        return _share(one.count, one.n, 0.025 / figures)
    wider = float(scipy.stats.norm.isf(0.025 / figures)) / Z95
    return replace(one, low=one.value + wider * (one.low - one.value), high=one.value + wider * (one.high - one.value))


def holding(what: str, rates: Mapping[str, Estimate | None], declared: float) -> Goal:
    """Goal that the intervals of all rates contain the declared one."""
    found = {name: one for name, one in rates.items() if one is not None}
    wide = [_together(one, len(found)) for one in found.values()]
    met = all(one.low <= declared <= one.high for one in wide)
    text = "; ".join(f"{name} {one}" for name, one in found.items())
    return Goal(what, f"{100 * declared:g} % inside", text or "–", ("met" if met else "missed") if found else "–")


def _limit(measured: Estimate, value: float) -> str:
    return f"{value:.3g}" if measured.count is None else f"{100 * value:.3g} %"


def _verdict(one: Estimate, wide: Estimate, low: float, high: float) -> str:
    if low <= one.value <= high:
        return "met"
    return "missed" if wide.high < low or wide.low > high else "within chance"


_Point = tuple[str | float, Estimate | float]


@dataclass(frozen=True, slots=True)
class Chart:
    """Points with intervals in panels, or distributions as steps."""

    name: str
    caption: str
    panels: Mapping[str, Mapping[str, Sequence[_Point]]]
    """Series by title; points of a series have an abscissa (a number or a word) and a figure."""
    x: str
    y: str
    steps: bool = False
    log: bool = False
    lines: tuple[float, ...] = ()  # horizontal lines


def panels(parts: Iterable[tuple[str, str, Iterable[_Point]]]) -> dict[str, dict[str, list[_Point]]]:
    """Panels of a chart, from tuples of panel title, name of a series, and some of its points."""
    found: dict[str, dict[str, list[_Point]]] = {}
    for title, name, points in parts:
        found.setdefault(title, {}).setdefault(name, []).extend(points)
    return found
