"""Correlation functions of one window, compared with the predictions of the trained networks for each equation."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from models.descriptor import descriptor_mismatch
from models.diagnosis.networks.bundle import Bundle
from models.diagnosis.networks.equations import EQUATIONS, Equation, SynchronousEquation
from models.diagnosis.networks.relation import EquationNetwork, not_read, read_equation, window_view
from models.diagnosis.window.moments import plan_for
from models.diagnosis.window.sliding import SlidingWindow
from models.diagnosis.window.statistics import WindowStatistics
from models.errors import RotorwatchError, WireError
from models.ingest import Gate
from models.machine import Machine, MachineFile
from models.signals.block import ComplexArray, FloatArray, SampleBlock
from models.signals.wire import decode_block
from rotorwatch.records.windows import Equation as EquationReading
from service.analysis.recorded import Recorded


@dataclass(frozen=True, slots=True)
class Curve:
    """Correlation of the response with one reference channel (or, for the synchronous equation, in one plane)."""

    label: str  # reference channel's state, or plane
    # (n_points,), target over its rms: as estimated in the window, and as the network predicts it from the other
    # correlations.
    measured: FloatArray
    predicted: FloatArray

    @property
    def residual(self) -> FloatArray:
        """Measured minus predicted."""
        return np.asarray(self.measured - self.predicted, dtype=np.float64)


@dataclass(frozen=True, slots=True)
class Panel:
    """Curves and reading of one compatibility equation."""

    target: str  # name of its target correlation
    over: str  # ``lag`` or ``angle``: what `x` is
    x: FloatArray  # (n_points,), lags, s; or shaft angles, rad
    curves: tuple[Curve, ...]  # empty if it cannot be evaluated
    # What the monitor reports: MSD here and in healthy windows, readings of the parameters, or why there are none.
    reading: EquationReading


def latest_window(data: Recorded, machine: MachineFile) -> WindowStatistics:
    """The latest full window in a recording, as a monitor that received it from its start would hold it.

    Raises
    ------
    RotorwatchError
        If there is no full window; the message says how much usable data there is.
    """
    window, gate = SlidingWindow(plan_for(machine)), Gate(machine)
    latest: WindowStatistics | None = None
    refusal, data_s = "", 0.0
    for block in _blocks(data, machine):
        verdict = gate.judge(block)
        if not verdict.accepted:
            refusal = verdict.text
            continue
        data_s += block.samples.shape[0] / block.rate_hz
        if not verdict.continuous:
            window.gap()
        if verdict.clock_step_s:
            window.clear()
        for _ in window.feed(window.plan.to_si(block.samples), block.start_ns):
            latest = window.statistics() or latest
    if latest is None:
        raise RotorwatchError(
            f"{data.place}: no full window of {data.name} before this time: a window is {machine.window.length_s:g} s, "
            f"usable data are {data_s:.3g} s" + (f"; latest refusal: {refusal}" if refusal else "")
        )
    return latest


def correlations_of(window: WindowStatistics, machine: Machine, bundle: Bundle) -> tuple[Panel, ...]:
    """All equations in a window: the numbers of the monitor's report, and the curves from which they are computed."""
    trained = {network.equation.number: network for network in bundle.networks}
    return tuple(_panel(equation, trained.get(equation.number), window, machine) for equation in EQUATIONS)


def _panel(
    equation: Equation | SynchronousEquation,
    trained: EquationNetwork | None,
    window: WindowStatistics,
    machine: Machine,
) -> Panel:
    synchronous = isinstance(equation, SynchronousEquation)
    target = "R[n,disc]" if isinstance(equation, SynchronousEquation) else equation.target.name
    over = "angle" if synchronous else "lag"
    reading = not_read(equation, "no trained network") if trained is None else read_equation(trained, window, machine)
    if trained is None or reading.reason:
        return Panel(target, over, np.empty(0), (), reading)
    view = window_view(window, machine)
    rows = equation.rows(view, machine)
    measured = rows.target / rows.norm
    predicted = trained.network(rows.inputs / rows.norm)
    if synchronous:  # one plane after the other, each at all shaft angles
        labels = ["disc y", "disc z"]
        n_points = measured.size // len(labels)
        x = np.asarray(np.arange(n_points) * (2 * np.pi / n_points), dtype=np.float64)
        columns = (measured.reshape(-1, n_points), predicted.reshape(-1, n_points))
    else:  # rows run over lags, then references; the equation's channels begin with the references, each with its rate
        n_points = view.correlation.shape[0]
        x = window.lags_s[-n_points:]
        columns = (measured.reshape(n_points, -1).T, predicted.reshape(n_points, -1).T)
        labels = list(equation.channels[: 2 * columns[0].shape[0] : 2])
    curves = tuple(Curve(label, one, other) for label, one, other in zip(labels, *columns, strict=True))
    return Panel(target, over, x, curves, reading)


def _blocks(data: Recorded, machine: MachineFile) -> Iterator[SampleBlock]:
    """Blocks that can be decoded.

    The schema hash covers site and name. If only these differ from the machine file, it is empty, i.e. not checked.
    """
    descriptor = data.source.descriptor(data.keys, data.from_ns)
    differences = () if descriptor is None else descriptor_mismatch(descriptor.payload, machine)
    only_named = all(text.startswith(("site is ", "machine is ")) for text in differences)
    other_name = (machine.site, machine.name) != (data.keys.site, data.keys.machine)
    for message in data.messages(data.keys.stream):
        try:
            block = decode_block(message.payload, message.attachment, message.encoding)
        except WireError:
            continue
        yield replace(block, schema_hash="") if other_name and only_named else block


@dataclass(frozen=True, slots=True)
class MeasuredCorrelations:
    """Correlation functions of pairs of channels, SI."""

    lags_s: FloatArray  # (n_lags,)
    # (n_lags, n_pairs), R_ij(τ) and its standard error.
    values: FloatArray
    errors: FloatArray
    band_hz: tuple[float, float] | None  # band of the spectra they were computed from; None if from the samples
    # (n_pairs,), covariance outside that band over the product of both rms; NaN if computed from the samples.
    outside_band: FloatArray


def measured_correlations(
    machine: MachineFile, window: WindowStatistics, pairs: list[tuple[int, int]]
) -> MeasuredCorrelations:
    """Correlation functions of column pairs (reference, response); from the spectra if the window only has lag zero."""
    reference, response = (np.array(column, dtype=np.intp) for column in zip(*pairs, strict=True))
    if window.lags_s.size > 1:
        hops = window.hop_correlation[:, :, reference, response]
        errors = hops.std(axis=0, ddof=1) / np.sqrt(hops.shape[0])
        values = window.correlation[:, reference, response]
        return MeasuredCorrelations(window.lags_s, values, errors, None, np.full(len(pairs), np.nan))
    segment_s = machine.window.segment_s
    lags_s = plan_for(machine).lags_s
    lags_s = lags_s[lags_s <= segment_s / 2]
    lowest_hz, highest_hz = float(window.frequencies_hz[0]), float(window.frequencies_hz[-1])
    spacing_hz = float(window.frequencies_hz[1]) - lowest_hz
    band_hz = (lowest_hz - spacing_hz / 2, highest_hz + spacing_hz / 2)
    turn = np.exp(-2j * np.pi * np.outer(lags_s, window.frequencies_hz))
    cross = window.spectrum[:, reference, response]
    values = 2 * spacing_hz * (turn @ cross).real / _hann_fade(lags_s / segment_s)[:, None]
    zero = window.correlation[0]
    rms = np.sqrt(zero[reference, reference] * zero[response, response])
    with np.errstate(invalid="ignore", divide="ignore"):  # a channel without motion gives NaN
        outside = (zero[reference, response] - values[0]) / rms
    errors = _bartlett_errors(window, reference, response, turn, spacing_hz)
    return MeasuredCorrelations(lags_s, values, errors, band_hz, outside)


def _bartlett_errors(
    window: WindowStatistics,
    reference: np.typing.NDArray[np.intp],
    response: np.typing.NDArray[np.intp],
    turn: ComplexArray,
    spacing_hz: float,
) -> FloatArray:
    """Standard errors of correlation functions estimated from T seconds of a Gaussian process.

    Var R̂_ij(τ) = (2/T) ∫ S_ii S_jj + Re{S_ij² e^{-4πjfτ}} df over positive frequencies (M. S. Bartlett, Supplement to
    the J. Roy. Statist. Soc. 8 (1946), for one channel). With n averages, the product of two estimated spectra exceeds
    that of the true spectra by the factor 1 + 1/n, which is divided out.
    """
    spectrum = window.spectrum
    own = spectrum[:, reference, reference].real * spectrum[:, response, response].real
    both = (turn**2 @ spectrum[:, reference, response] ** 2).real
    variance = 2 * spacing_hz / window.duration_s * (own.sum(axis=0) + both)
    return np.asarray(np.sqrt(np.maximum(variance, 0) / (1 + 1 / window.n_segments)), dtype=np.float64)


def _hann_fade(part: FloatArray) -> FloatArray:
    """Factor by which Hann windowing reduces a correlation at a lag given as a fraction of the segment's length."""
    angle = 2 * np.pi * part
    return np.asarray((1 - part) * (2 + np.cos(angle)) / 3 + np.sin(angle) / (2 * np.pi), dtype=np.float64)
