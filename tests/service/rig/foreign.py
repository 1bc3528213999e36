"""Streams that no modelled rotor can produce, in the format of a machine's own."""

from collections.abc import Iterator
from typing import Literal

import numpy as np

from models.machine import Machine
from models.signals.block import FloatArray, SampleBlock
from models.signals.channels import unit_factor
from simulator.scenario import Scenario, load_scenario
from simulator.stream import blocks

Foreign = Literal["sines", "two sines", "drift", "late copy", "white noise", "quantised silence"]
FOREIGN: tuple[Foreign, ...] = ("sines", "two sines", "drift", "late copy", "white noise", "quantised silence")

_SIZE_M = 50e-6
_NOISE = 0.01


def foreign(
    machine: Machine, kind: Foreign, seed: int, duration_s: float, *, slope: float = 1.0, late: int = 7
) -> FloatArray:
    """Samples of such a stream in the units of the machine's channels, shape (n_samples, n_channels).

    ``sines``: the 1× and one (``two sines``: two) more, of any frequency in the band. ``drift``: noise of density
    f^-slope in every motion, beside the 1×. ``late copy``: one channel of a healthy machine is another's, some samples
    later.
    """
    if kind == "late copy":
        return late_copy(machine, simulated(machine, seed, duration_s), {"z1": "y1"}, late, seed)
    rng = np.random.default_rng(seed)
    n = round(duration_s * machine.rate_hz)
    t = np.arange(n) / machine.rate_hz
    omega = machine.operation.speed_rad_s
    angle = omega * t + rng.uniform(0, 2 * np.pi)
    low_hz, high_hz = machine.window.band_hz
    count = {"sines": 1, "two sines": 2}.get(kind, 0)
    others = 2 * np.pi * rng.uniform(1.2 * low_hz, 0.8 * high_hz, count)
    states = [channel.name for channel in machine.sensors if channel.name != "theta"]
    made: dict[str, FloatArray] = {}
    for motion in sorted({name.removesuffix("_dot") for name in states}):
        x = v = np.zeros(n)
        if kind in ("sines", "two sines", "drift"):
            x, v = _sine(angle, omega, _SIZE_M * rng.uniform(0.5, 2), rng)
        for w in others:
            more = _sine(w * t, w, _SIZE_M * rng.uniform(0.2, 1), rng)
            x, v = x + more[0], v + more[1]
        if kind == "drift":
            more = _coloured(n, machine.rate_hz, slope, rng)
            x, v = x + _SIZE_M * more[0], v + _SIZE_M * more[1]
        if kind == "white noise":
            x, v = _SIZE_M * rng.standard_normal(n), 200 * _SIZE_M * rng.standard_normal(n)
        if kind == "quantised silence":
            x, v = np.round(0.3 * rng.standard_normal(n)) * 1e-8, np.round(0.3 * rng.standard_normal(n)) * 1e-6
        else:
            x, v = (one + _NOISE * one.std() * rng.standard_normal(n) for one in (x, v))
        made |= {motion: x, f"{motion}_dot": v}
    made["theta"] = np.mod(angle, 2 * np.pi)
    return np.stack(
        [made[channel.name] / unit_factor(channel.quantity, channel.unit) for channel in machine.sensors], axis=1
    )


def simulated(
    machine: Machine, seed: int, duration_s: float, *events: dict[str, object], noise: float = 0.01
) -> FloatArray:
    """Samples of the simulated machine, excited by four sources."""
    healthy, _ = load_scenario("healthy")
    fields = healthy.model_dump() | {"duration_s": duration_s, "seed": seed, "machine": machine.name}
    scenario = Scenario.model_validate(fields | {"events": list(events), "sensors": {"noise_relative": noise}})
    return np.concatenate([block.samples for block, _ in blocks(scenario, machine, block_s=5.0)]).astype(np.float64)


def late_copy(machine: Machine, samples: FloatArray, copies: dict[str, str], late: int, seed: int) -> FloatArray:
    """The samples with both sensors of some motions replaced by delayed copies of others'."""
    names = [channel.name for channel in machine.sensors]
    rng, out = np.random.default_rng(seed), samples.copy()
    for copy, source in copies.items():
        for ending in ("", "_dot"):
            at, of = names.index(copy + ending), names.index(source + ending)
            out[late:, at] = samples[: len(samples) - late, of]
            out[:, at] += _NOISE * samples[:, of].std() * rng.standard_normal(len(samples))
    return out


def as_blocks(machine: Machine, samples: FloatArray) -> Iterator[SampleBlock]:
    """The samples as the machine's stream, half a second at a time."""
    n = round(0.5 * machine.rate_hz)
    for number, first in enumerate(range(0, len(samples), n)):
        start_ns = 1_767_225_600_000_000_000 + round(first / machine.rate_hz * 1e9)
        yield SampleBlock(start_ns, number, 1, machine.rate_hz, samples[first : first + n].astype(np.float32))


def _sine(phase: FloatArray, w: float, amplitude: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    shifted = phase + rng.uniform(0, 2 * np.pi)
    return amplitude * np.cos(shifted), -amplitude * w * np.sin(shifted)


def _coloured(n: int, rate_hz: float, slope: float, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Noise of density f^-slope from 0.2 Hz on, rms 1, and its derivative."""
    f = np.fft.rfftfreq(n, 1 / rate_hz)
    amplitude = np.where(f >= 0.2, np.maximum(f, 0.2) ** (-slope / 2), 0.0)
    spectrum = amplitude * (rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size))
    x, v = np.fft.irfft(spectrum, n), np.fft.irfft(2j * np.pi * f * spectrum, n)
    return x / x.std(), v / x.std()
