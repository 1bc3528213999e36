"""What the evaluated windows add up to: bias, spread, coverage and rates, cell by cell.

Spread is a robust standard deviation, 1.4826 times the median distance from the median; set against the Cramér-Rao
bound or the stated standard error, every window's deviation is first divided by its own, because both vary from window
to window by an order of magnitude. Intervals of rates are Clopper-Pearson, those of spreads come from resampling the
windows, at 95 %.

A refused window counts as one in which nothing is named; it has no readings to cover anything.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from pydantic import BaseModel, ConfigDict

from models.diagnosis.readings import Z95
from models.physics.parameters import PARAMETERS
from models.signals.block import FloatArray
from simulator.campaigns.evaluation import RATES, Opinion, WindowRecord
from simulator.campaigns.evaluation_cells import Topic
from simulator.campaigns.rates import Rate
from simulator.training.draws import Anomaly, Excitation, Layout

__all__ = [
    "Campaign",
    "CellSummary",
    "Interval",
    "OpinionSummary",
    "ParameterSummary",
    "Summary",
    "pooled",
    "summarise",
]

_STRICT = ConfigDict(extra="forbid", frozen=True)
_RESAMPLINGS = 400
_RESAMPLING_SEED = 20261
_SHAFT = "EI"
_STEPS = (np.arange(40) + 0.5) / 40
_FEWEST = 4
"""A spread of fewer windows says nothing."""


class Interval(BaseModel):
    """A number with its 95 % interval."""

    model_config = _STRICT

    value: float
    low: float
    high: float

    @classmethod
    def resampled(cls, statistic: Callable[[FloatArray], FloatArray], values: FloatArray) -> "Interval":
        """Resample the windows; the statistic works on the last axis. Seed fixed: the same windows, the same limits."""
        rng = np.random.default_rng(_RESAMPLING_SEED)
        drawn = statistic(values[rng.integers(len(values), size=(_RESAMPLINGS, len(values)))])
        low, high = np.quantile(drawn, (0.025, 0.975)).tolist()
        return cls(value=float(statistic(values)), low=low, high=high)


class ParameterSummary(BaseModel):
    """One parameter in one cell, as one diagnostician reads it. Relative changes and errors, 0.01 = 1 %.

    Attributes
    ----------
    name : str
    truth : float or None
        True change; None if it varies from window to window.
    n : int
        Windows with a reading.
    median : float
        Of the readings.
    bias : float
        Mean of reading minus truth.
    bias_in_errors : Interval
        Mean of (reading - truth) / standard error.
    spread : Interval or None
        Robust standard deviation of reading minus truth; None with too few windows.
    rms : float
        Root of the mean squared deviation from the truth.
    standard_error : float
        Median of what the windows state.
    spread_in_errors : Interval or None
        Robust standard deviation of (reading - truth) / standard error: 1 where errors are stated rightly.
    bound : float or None
        Median Cramér-Rao bound of the windows that have one.
    bound_quantiles : tuple of float
        Of those bounds, in equal steps: their mean over any function of the bound is its mean over the windows.
    spread_in_bounds : Interval or None
        Robust standard deviation of (reading - truth) / bound.
    covered : Rate
        Windows whose 95 % interval holds the truth.
    found : tuple of Rate
        At each of `RATES`: named, of the windows in which it changed. Empty if it never did.
    mistaken : tuple of Rate
        At each of `RATES`: named, of the windows in which it did not change. Empty if it always did.
    """

    model_config = _STRICT

    name: str
    truth: float | None
    n: int
    median: float
    bias: float
    bias_in_errors: Interval
    spread: Interval | None = None
    rms: float
    standard_error: float
    spread_in_errors: Interval | None = None
    bound: float | None = None
    bound_quantiles: tuple[float, ...] = ()
    spread_in_bounds: Interval | None = None
    covered: Rate
    found: tuple[Rate, ...] = ()
    mistaken: tuple[Rate, ...] = ()


class OpinionSummary(BaseModel):
    """What one diagnostician made of a cell; every tuple has one rate for each of `RATES`, of all windows.

    Attributes
    ----------
    n, refused : int
        Windows, and those that were not evaluated.
    reasons : dict of str to int
        Why not.
    parameters : tuple of ParameterSummary
    any_named : tuple of Rate
        Any parameter named: in healthy cells a false alarm.
    exact : tuple of Rate
        Exactly the changed parameters named.
    wrong : tuple of Rate
        At least one parameter named that did not change.
    outside : tuple of Rate
        Declared outside the model.
    noticed : tuple of Rate
        Declared outside the model, or a suspect named.
    claimed : tuple of Rate
        A bearing parameter or the unbalance named and the window not declared outside: in cells outside the model a
        wrong claim made without reserve.
    claimed_shaft : tuple of Rate
        The same of the shaft alone.
    suspects : dict of str to int
        What was suspected (its size left out), most frequent first.
    misfit_z : tuple of float
        5, 25, 50, 75 and 95 % quantiles; empty where there is no such test.
    milliseconds : float
        Median processor time of a window.
    """

    model_config = _STRICT

    n: int
    refused: int
    reasons: dict[str, int] = {}
    parameters: tuple[ParameterSummary, ...] = ()
    any_named: tuple[Rate, ...]
    exact: tuple[Rate, ...]
    wrong: tuple[Rate, ...]
    outside: tuple[Rate, ...]
    noticed: tuple[Rate, ...]
    claimed: tuple[Rate, ...]
    claimed_shaft: tuple[Rate, ...]
    suspects: dict[str, int] = {}
    misfit_z: tuple[float, ...] = ()
    milliseconds: float

    def parameter(self, name: str) -> ParameterSummary | None:
        """One parameter's figures; None if it was never read."""
        return next((one for one in self.parameters if one.name == name), None)


class CellSummary(BaseModel):
    """Windows of one kind and one layout.

    Attributes
    ----------
    cell : int
        Number in the plan.
    truth : dict of str to float or None
        None where it is drawn for every window.
    """

    model_config = _STRICT

    cell: int
    topic: Topic
    layout: Layout
    excitation: Excitation
    anomaly: Anomaly
    length_s: float
    truth: dict[str, float] | None
    n: int
    opinions: dict[str, OpinionSummary]


class Campaign(BaseModel):
    """What the windows were made with; windows of different campaigns are never mixed.

    Attributes
    ----------
    machine : str
    physics : str
        Digest of the machine's physical figures.
    bundle : str
        Identity of the bundle; empty without one.
    bundle_name : str
        What was given on the command line.
    seed : int
    windows : int
        Of a cell of weight one.
    fault : float
    full : bool
    plan : str
        Digest of the cells.
    """

    model_config = _STRICT

    machine: str
    physics: str
    bundle: str = ""
    bundle_name: str = ""
    seed: int
    windows: int
    fault: float
    full: bool
    plan: str = ""


class Summary(BaseModel):
    """One machine's evaluation."""

    model_config = _STRICT

    campaign: Campaign
    length_s: float
    rates: tuple[float, ...] = RATES
    windows: int
    cells: tuple[CellSummary, ...]

    @property
    def diagnosticians(self) -> tuple[str, ...]:
        """Who was asked, the likelihood first."""
        asked = {by for cell in self.cells for by in cell.opinions}
        known = [by for by in ("likelihood", "network", "relation") if by in asked]
        return (*known, *sorted(asked - set(known)))

    def of(self, *topics: Topic, layout: Layout | None = None) -> list[CellSummary]:
        """Cells of some topics."""
        return [c for c in self.cells if c.topic in topics and (layout is None or c.layout == layout)]


def pooled(rates: Iterable[Rate]) -> Rate | None:
    """One rate of all windows together; None without any."""
    listed = list(rates)
    total = sum(rate.of for rate in listed)
    return Rate.of_counts(sum(rate.count for rate in listed), total) if total else None


def summarise(records: Iterable[WindowRecord], campaign: Campaign) -> Summary:
    """Add up the windows of one machine.

    Parameters
    ----------
    records : iterable of WindowRecord
        In any order; grouped by cell and layout.
    campaign : Campaign

    Returns
    -------
    Summary
        Cells in the order of the plan, one source before independent sources.

    Raises
    ------
    ValueError
        Without any record.
    """
    groups: dict[tuple[int, Layout], list[WindowRecord]] = defaultdict(list)
    for record in records:
        groups[record.cell, record.layout].append(record)
    if not groups:
        raise ValueError(f"{campaign.machine}: no evaluated windows, expected at least one")
    cells = tuple(_cell(groups[key]) for key in sorted(groups))
    own_length = [cell.length_s for cell in cells if cell.topic is not Topic.LENGTH]
    return Summary(
        campaign=campaign,
        length_s=own_length[0] if own_length else cells[0].length_s,
        windows=sum(cell.n for cell in cells),
        cells=cells,
    )


def _cell(records: list[WindowRecord]) -> CellSummary:
    first = records[0]
    asked = sorted({by for record in records for by in record.opinions})
    return CellSummary(
        cell=first.cell,
        topic=first.topic,
        layout=first.layout,
        excitation=first.excitation,
        anomaly=first.anomaly,
        length_s=first.length_s,
        truth=first.truth if all(record.truth == first.truth for record in records) else None,
        n=len(records),
        opinions={by: _opinion([record for record in records if by in record.opinions], by) for by in asked},
    )


def _opinion(records: list[WindowRecord], by: str) -> OpinionSummary:
    asked = [(record, record.opinions[by]) for record in records]
    said = [opinion for _, opinion in asked]
    misfits = [opinion.misfit_z for opinion in said if opinion.misfit_z is not None]

    def rates(holds: Callable[[WindowRecord, Opinion, int], bool]) -> tuple[Rate, ...]:
        return tuple(
            Rate.of_counts(sum(holds(record, opinion, at) for record, opinion in asked), len(asked))
            for at in range(len(RATES))
        )

    read = [_parameter(name, asked) for name in PARAMETERS]
    return OpinionSummary(
        n=len(asked),
        refused=sum(bool(opinion.refused) for opinion in said),
        reasons=_most_frequent(opinion.refused for opinion in said),
        parameters=tuple(one for one in read if one is not None),
        any_named=rates(lambda _, opinion, at: bool(_named(opinion, at))),
        exact=rates(lambda record, opinion, at: set(_named(opinion, at)) == set(record.truth)),
        wrong=rates(lambda record, opinion, at: bool(set(_named(opinion, at)) - set(record.truth))),
        outside=rates(lambda _, opinion, at: _outside(opinion, at)),
        noticed=rates(lambda _, opinion, at: _outside(opinion, at) or bool(opinion.suspect)),
        claimed=rates(lambda _, opinion, at: bool({*_named(opinion, at)} - {_SHAFT}) and not _outside(opinion, at)),
        claimed_shaft=rates(lambda _, opinion, at: _named(opinion, at) == (_SHAFT,) and not _outside(opinion, at)),
        suspects=_most_frequent(opinion.suspect.split(" (")[0] for opinion in said),
        misfit_z=tuple(np.quantile(misfits, (0.05, 0.25, 0.5, 0.75, 0.95)).tolist()) if misfits else (),
        milliseconds=float(np.median([1000 * opinion.seconds for opinion in said])),
    )


def _named(opinion: Opinion, at: int) -> tuple[str, ...]:
    return opinion.named[at] if opinion.named else ()


def _outside(opinion: Opinion, at: int) -> bool:
    return bool(opinion.outside) and opinion.outside[at]


def _most_frequent(texts: Iterable[str]) -> dict[str, int]:
    return dict(Counter(text for text in texts if text).most_common(8))


def _parameter(name: str, asked: Sequence[tuple[WindowRecord, Opinion]]) -> ParameterSummary | None:
    read = [(record, opinion) for record, opinion in asked if name in opinion.change]
    if not read:
        return None
    truth = np.array([record.truth.get(name, 0.0) for record, _ in read])
    change = np.array([opinion.change[name] for _, opinion in read])
    error = np.array([opinion.error[name] for _, opinion in read])
    deviation = change - truth
    bounded = [n for n, (record, _) in enumerate(read) if name in record.bound]
    bound = np.array([read[n][0].bound[name] for n in bounded])
    altered = [opinion for record, opinion in asked if record.truth.get(name)]
    unaltered = [opinion for record, opinion in asked if not record.truth.get(name)]
    return ParameterSummary(
        name=name,
        truth=float(truth[0]) if np.all(truth == truth[0]) else None,
        n=len(read),
        median=float(np.median(change)),
        bias=float(np.mean(deviation)),
        bias_in_errors=_mean(deviation / error),
        spread=_spread(deviation),
        rms=float(np.sqrt(np.mean(deviation**2))),
        standard_error=float(np.median(error)),
        spread_in_errors=_spread(deviation / error),
        bound=float(np.median(bound)) if bounded else None,
        bound_quantiles=tuple(np.quantile(bound, _STEPS).tolist()) if bounded else (),
        spread_in_bounds=_spread(deviation[bounded] / bound) if bounded else None,
        covered=Rate.of_counts(int(np.sum(np.abs(deviation) <= Z95 * error)), len(read)),
        found=_named_rates(name, altered),
        mistaken=_named_rates(name, unaltered),
    )


def _named_rates(name: str, opinions: Sequence[Opinion]) -> tuple[Rate, ...]:
    if not opinions:
        return ()
    return tuple(
        Rate.of_counts(sum(name in _named(opinion, at) for opinion in opinions), len(opinions))
        for at in range(len(RATES))
    )


def _robust(values: FloatArray) -> FloatArray:
    """1.4826 times the median distance from the median, over the last axis."""
    middle = np.median(values, axis=-1, keepdims=True)
    return np.asarray(1.4826 * np.median(np.abs(values - middle), axis=-1), dtype=np.float64)


def _spread(values: FloatArray) -> Interval | None:
    return Interval.resampled(_robust, values) if len(values) >= _FEWEST else None


def _mean(values: FloatArray) -> Interval:
    middle = float(np.mean(values))
    # One window has no scatter: there its own standard error is all that is known.
    half = Z95 * (float(np.std(values, ddof=1)) / len(values) ** 0.5 if len(values) > 1 else 1.0)
    return Interval(value=middle, low=middle - half, high=middle + half)
