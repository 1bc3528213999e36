"""How often levels of healthy machines exceed their limits over years; windows are drawn, not simulated in time.

The contribution of a hop to a window's levels is drawn from its sampling distribution: for every band a mean square,
gamma distributed for noise, plus lines and their product with the noise; for every order a complex normal vector.
Windows, reference and limits are then computed by the program's own code. As a check, hours of the same machines are
also simulated in time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np
import scipy.stats

from benchmarks.studies.reporting import results as r
from benchmarks.studies.reporting.results import Estimate, Goal, Record, Table, Value
from benchmarks.studies.reporting.study import Cell, Options, Study
from benchmarks.studies.subjects.level_streams import KINDS, At, Scene, drawn, generator, steady
from models.diagnosis.verdict.calibration import MONTH_S
from models.levels.bands import NYQUIST_PART, band_edges
from models.levels.judgement import LevelJudge
from models.levels.measures import HopLevels, LevelPlan, WindowLevels, hop_levels, level_plan, window_levels
from models.levels.orders import ORDERS
from models.levels.reference import learn_levels
from models.levels.settings import LevelSettings
from models.signals.block import FloatArray
from models.signals.waveform import waveform_of
from rotorwatch.records.levels import ChannelLevels

REFERENCES = ("first windows", "commissioned")
SPREADS, DRAWN = (0.1, 0.2), ("inside the reference's range", "same distribution")
_LENGTH_S, _HOP_S = 60.0, 5.0  # defaults of a machine file
_HOPS = round(_LENGTH_S / _HOP_S)
_DAY_S = 86400.0
_KIND = replace(KINDS["velocity sensors, speed in the machine file"], rate_hz=1280.0)
_COMPARED = ("overall", "x1", "x2", "bands")


@dataclass(frozen=True, slots=True)
class Drawing:
    """Sampling distribution of the contribution of one hop of a scene to the levels; SI units, by channel."""

    plan: LevelPlan
    n_samples: int
    speed_rad_s: float
    noise: FloatArray  # (n_bands, n): mean squares of the noise
    averages: FloatArray  # (n_bands,): number of independent squares in each mean
    line: FloatArray  # (n_bands, n): mean squares of the lines
    product: FloatArray  # (n_bands, n): standard deviation of twice the product of lines and noise
    orders: FloatArray  # (4, n): amplitudes at the orders of `ORDERS`
    order_noise: FloatArray  # (4, n): mean squares of the noise of a vector at these orders
    in_band: FloatArray  # (n_bands,): fraction of each band inside the band of velocity levels

    @classmethod
    def of(cls, scene: Scene) -> Self:
        """The distribution, from the scene's lines and the spectrum of its noise."""
        sensors, rate_hz = scene.machine.sensors, scene.kind.rate_hz
        plan = level_plan(sensors, rate_hz, scene.machine.levels.band(60 * scene.speed_hz))
        n, to_si = round(_HOP_S * rate_hz), np.array([one.to_si for one in sensors])
        taper = np.hanning(n + 1)[:-1]
        scale = 2 / (n * float(taper @ taper))
        edges = np.append(band_edges(n), int(NYQUIST_PART * (n // 2)) + 1)  # plus the rest of the velocity band
        bins = np.arange(edges[-1])
        poles, rms = scene.poles, scene.noise * to_si

        def density(cycles: FloatArray) -> FloatArray:
            """Noise power over that of unit white noise, at frequencies in cycles per sample; shape (.., n)."""
            response = np.abs(1 - poles * np.exp(-2j * np.pi * cycles[:, None])) ** -2
            return np.asarray(rms**2 * (1 - poles**2) * response, dtype=np.float64)

        power = density(bins / n)
        # Adjacent bins of a Hann-windowed spectrum are correlated by -2/3, bins two apart by 1/6.
        counts = np.diff(edges).astype(np.float64)
        pairs = counts + 2 * np.maximum(counts - 1, 0) * (2 / 3) ** 2 + 2 * np.maximum(counts - 2, 0) / 6**2
        angles = 2 * np.pi * scene.speed_hz / rate_hz * np.outer(np.arange(1.0, 4.0), np.arange(n))
        waves = [(scene.lines[:, c] * to_si[c]) @ np.cos(angles + scene.phases[:, c, None]) for c in range(2)]
        spectra = np.fft.rfft(np.array(waves) * taper, axis=1)[:, : edges[-1]].T
        beside = np.stack([np.convolve(one, (1 / 6, -2 / 3, 1, -2 / 3, 1 / 6), "same") for one in spectra.T], axis=1)
        crossed = np.maximum((spectra.conj() * beside).real, 0) * power * float(taper @ taper)
        middle_hz = bins * rate_hz / n
        within = (middle_hz >= plan.band_hz[0]) & (middle_hz <= plan.band_hz[1])
        at = np.array(list(ORDERS.values()))
        return cls(
            plan,
            n,
            2 * np.pi * scene.speed_hz,
            np.add.reduceat(power * 2 / n, edges[:-1], axis=0),
            counts**2 / pairs,
            scale * np.add.reduceat(np.abs(spectra) ** 2, edges[:-1], axis=0),
            np.sqrt(2 * np.add.reduceat(crossed, edges[:-1], axis=0)) * scale,
            np.vstack([np.zeros(2), scene.lines * to_si]),
            density(at * scene.speed_hz / rate_hz) * 4 * float(taper @ taper) / float(taper.sum()) ** 2,
            np.add.reduceat(within.astype(np.float64), edges[:-1]) / counts,
        )

    def windows(self, rng: np.random.Generator, gains: FloatArray) -> Iterator[WindowLevels]:
        """Levels of non-overlapping windows, with one gain of the noise for each window."""
        for part in np.array_split(gains, max(1, gains.size // 256)):
            gain = np.repeat(part, _HOPS)[:, None, None]
            shape = (gain.size, *self.noise.shape)
            noise = rng.standard_gamma(self.averages[:, None], shape) * (self.noise / self.averages[:, None])
            bands = gain**2 * noise + self.line + gain * self.product * rng.standard_normal(shape)
            bands = np.maximum(bands, 0.0)
            both = rng.standard_normal((gain.size, 2, *self.orders.shape))
            vectors = self.orders + gain * np.sqrt(self.order_noise / 2) * (both[:, 0] + 1j * both[:, 1])
            hops = []
            for number in range(gain.size):
                sums = np.ones((11, bands.shape[2]))
                sums[[0, 6]], sums[4:6], sums[8] = 0.0, np.nan, self.in_band @ bands[number]
                hops.append(
                    HopLevels(self.n_samples, sums, vectors[number], bands[number, :-1], np.empty((0, bands.shape[2])))
                )
            yield from _windows(self.plan, hops, self.speed_rad_s)


def _windows(plan: LevelPlan, hops: Sequence[HopLevels], speed_rad_s: float) -> Iterator[WindowLevels]:
    speeds = np.full(_HOPS, speed_rad_s)
    for first in range(0, len(hops), _HOPS):
        yield window_levels(plan, hops[first : first + _HOPS], speeds, phase_reference=False)


def _years(
    options: Options, reference: str, spread: float, how: str, case: int, _: None, number: int
) -> Iterator[dict[str, Value]]:
    """One day of a machine in non-overlapping windows, each with its own level of noise."""
    scene = drawn(_KIND, generator(options.seed, case, number, At.CONDITION), noise_over_1x=(1.0, 3.0))
    learned, watched = (generator(options.seed, case, number, at) for at in (At.REFERENCE, At.EVALUATION))
    drawing, given = Drawing.of(scene), LevelSettings()
    seen = np.exp(spread * learned.standard_normal(given.reference_windows if reference == REFERENCES[0] else 30))
    known = learn_levels(reference, [one.name for one in scene.machine.sensors], list(drawing.windows(learned, seen)))
    count = round((_DAY_S / 100 if options.small else _DAY_S) / _LENGTH_S)
    gains = np.exp(spread * watched.standard_normal(count))
    if how == DRAWN[0]:
        gains = watched.uniform(seen.min(), seen.max(), count)
    judge = LevelJudge(drawing.plan, scene.machine.sensors, given)
    beyond = [_beyond(judge.judge(levels, known)) for levels in drawing.windows(watched, gains)]
    yield {
        "hours": count * _LENGTH_S / 3600,
        "alarms": sum(map(bool, beyond)),
        **{f"by_{name}": sum(name in one for one in beyond) for name in ("overall", "x1", "x2", "growth")},
    }


def _beyond(levels: Sequence[ChannelLevels]) -> set[str]:
    return {limit.measure for one in levels for limit in one.limits if limit.state != "normal"}


def _beside(options: Options, case: int, _: None, number: int) -> Iterator[dict[str, Value]]:
    """Compare two hours of one machine simulated in time with drawn ones: mean and scatter of the log levels."""
    scene = drawn(_KIND, generator(options.seed, case, number, At.CONDITION), noise_over_1x=(1.0, 3.0))
    rng, own = (generator(options.seed, case, number, at) for at in (At.REFERENCE, At.EVALUATION))
    drawing = Drawing.of(scene)
    count = round((_DAY_S / 100 if options.small else _DAY_S / 12) / _LENGTH_S)
    to_si = np.array([one.to_si for one in scene.machine.sensors])
    hops, pieces = list[HopLevels](), list[FloatArray]()
    for block in scene.blocks(rng, count * _LENGTH_S, steady):
        pieces.append(block.samples.astype(np.float64) * to_si)
        if len(pieces) == round(_HOP_S):
            angle = drawing.speed_rad_s * (np.arange(drawing.n_samples) / _KIND.rate_hz + len(hops) * _HOP_S)
            hops.append(hop_levels(drawing.plan, *waveform_of(np.concatenate(pieces)), np.mod(angle, 2 * np.pi)))
            pieces = []
    simulated = list(_windows(drawing.plan, hops, drawing.speed_rad_s))
    both = simulated, list(drawing.windows(own, np.ones(count)))
    for name in _COMPARED:
        of_time, of_draw = (np.log(np.array([_level(one, name) for one in windows])) for windows in both)
        for column in range(2):
            mean, scatter = (of_time[..., column].mean(axis=0), of_time[..., column].std(axis=0))
            other, wide = (of_draw[..., column].mean(axis=0), of_draw[..., column].std(axis=0))
            far = [float(np.quantile((one[..., column] - mean) / scatter, 0.975)) for one in (of_time, of_draw)]
            yield {
                "measure": name,
                "mean": float(np.mean(other - mean)),
                "scatter": float(np.median(wide / scatter)),
                "far": far[1] / far[0],
                "windows": count,
            }


def _level(levels: WindowLevels, name: str) -> FloatArray:
    if name != "bands":
        return levels.values[name]
    return levels.bands.rms


def per_month(rows: Sequence[Record]) -> Estimate | None:
    """Alarms per machine and month, with the exact 95 % interval of a Poisson count."""
    hours = r.statistic("hours", np.sum)(rows)
    if not hours:
        return None
    count, months = round(r.statistic("alarms", np.sum)(rows) or 0), hours * 3600 / MONTH_S
    low = 0.0 if not count else float(scipy.stats.chi2.ppf(0.025, 2 * count)) / 2
    high = float(scipy.stats.chi2.ppf(0.975, 2 * count + 2)) / 2
    return Estimate(count / months, low / months, high / months, len(rows))


_TABLES = (
    Table(
        "level-years",
        ("machine", "excitation"),
        {
            "days": r.statistic("hours", lambda hours: np.sum(hours) / 24),
            "windows beyond a limit": r.statistic("alarms", np.sum),
            "of the overall": r.statistic("by_overall", np.sum),
            "of 1x": r.statistic("by_x1", np.sum),
            "of 2x": r.statistic("by_x2", np.sum),
            "of a band": r.statistic("by_growth", np.sum),
            "per machine and month": per_month,
        },
        partial(r.where, topic="years"),
        "Healthy machines whose excitation varies; spread of its logarithm, and what it is drawn from:",
    ),
    Table(
        "level-drawing",
        ("measure",),
        {
            "windows": r.statistic("windows", np.sum),
            "mean of the logarithm, drawn less simulated, median": r.middle("mean"),
            "scatter, drawn over simulated, median": r.middle("scatter"),
            "97.5 % quantile, drawn over simulated, median": r.middle("far"),
        },
        partial(r.where, topic="beside"),
        "The drawing beside a simulation in time, channel by channel:",
    ),
)


def _goals(records: Sequence[Record]) -> Iterator[Goal]:
    inside = [row for row in r.where(records, topic="years") if str(row["excitation"]).endswith(DRAWN[0])]
    yield r.at_most("windows beyond a limit per month, excitation inside the reference's range", per_month(inside), 1.0)


def level_years(options: Options) -> Study:
    """Levels of healthy machines over years."""
    plan = [
        ("years", of, f"{spread:g}, {how}", weight, partial(_years, options, of, spread, how))
        for of in REFERENCES
        for spread in SPREADS
        for how, weight in zip(DRAWN, (13.0, 1.0), strict=True)
    ]
    plan.append(("beside", "", "", 1.72, partial(_beside, options)))
    cells = tuple(
        Cell(
            {"topic": topic, "machine": of, "excitation": varied},
            max(1, round(options.windows * (1.0 if options.small else weight))),
            partial(measure, 3000 + 100 * at),
        )
        for at, (topic, of, varied, weight, measure) in enumerate(plan)
    )
    return Study(name="level_years", cells=cells, tables=_TABLES, goals=_goals)
