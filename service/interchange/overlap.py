"""Filtering of stretches of any length in overlapping windows, so that memory use is constant.

Each window has context before and after the rows whose result is kept. The first and last rows of a stretch lack
context; the result there is invalid and left out.

A filter states the number of rows at multiples of which its windows start (`multiple`), the rows of context before and
after (`context`), and the columns that it changes (`columns`). It is called with times and samples of a window, context
included, and with the first row of the stretch, and returns times and samples of the rows between the contexts.

Where a channel is missing, the filter input is interpolated linearly, and all output within reach is missing too.
"""

from collections.abc import Iterator
from fractions import Fraction

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.signal import resample_poly

from models.signals.block import FloatArray, integrated, settling_s
from service.interchange.samples import Piece, Signal

_CORE_ROWS = 65536


class Overlap:
    """Runs a filter over pieces, and keeps the rows that the next window needs."""

    def __init__(self, window_filter: "Integration | Resampling") -> None:
        self._filter = window_filter
        self._context = window_filter.context
        self._core = -(-max(_CORE_ROWS, self._context) // window_filter.multiple) * window_filter.multiple
        self._time_ns: list[FloatArray] = []
        self._samples: list[FloatArray] = []
        self._rows = 0
        self._level = np.empty(0)
        self._begins = False
        self.cut_rows = 0

    def feed(self, pieces: Iterator[Piece]) -> Iterator[Piece]:
        """Filter all pieces of a file."""
        for piece in pieces:
            if piece.begins:
                yield from self._finish()
                self._begins, self._level = True, np.nan_to_num(piece.samples[0])
            self._time_ns.append(piece.time_ns)
            self._samples.append(piece.samples)
            self._rows += piece.time_ns.size
            while self._rows >= self._core + 2 * self._context:
                yield from self._window(self._core + 2 * self._context, self._core)
        yield from self._finish()

    def _finish(self) -> Iterator[Piece]:
        """Filter the rest of a stretch at its end."""
        if self._rows > 2 * self._context:
            yield from self._window(self._rows, self._rows)
            self.cut_rows += 2 * self._context
        else:
            self.cut_rows += self._rows
        self._time_ns, self._samples, self._rows = [], [], 0

    def _window(self, length: int, advance: int) -> Iterator[Piece]:
        time_ns, samples = np.concatenate(self._time_ns), np.concatenate(self._samples)
        result = self._filtered(time_ns[:length], samples[:length])
        if result[0].size:
            yield Piece(self._begins, *result)
            self._begins = False
        self._time_ns, self._samples = [time_ns[advance:]], [samples[advance:]]
        self._rows -= advance

    def _filtered(self, time_ns: FloatArray, samples: FloatArray) -> tuple[FloatArray, FloatArray]:
        lost = np.isnan(samples)
        if not lost.any():
            return self._filter(time_ns, samples, self._level)
        bridged, rows = samples.copy(), np.arange(time_ns.size)
        for number in np.flatnonzero(lost.any(axis=0)):
            there = np.flatnonzero(~lost[:, number])
            bridged[:, number] = np.interp(rows, there, samples[there, number]) if there.size else 0.0
        new_ns, result = self._filter(time_ns, bridged, self._level)
        reached, columns = lost.copy(), self._filter.columns
        reached[:, columns] = maximum_filter1d(lost[:, columns], 2 * self._context + 1, axis=0)
        # The filter may have changed the rate.
        at = self._context + np.arange(new_ns.size) * (time_ns.size - 2 * self._context) // max(1, new_ns.size)
        result[reached[at]] = np.nan
        return new_ns, result


class Integration:
    """Integrates the accelerometers among the columns; other columns pass unchanged."""

    multiple = 1

    def __init__(self, signals: list[Signal], rate_hz: float, high_pass_hz: float) -> None:
        self._signals, self._rate_hz, self._high_pass_hz = signals, rate_hz, high_pass_hz
        self.columns: slice | list[int] = [number for number, signal in enumerate(signals) if signal.integrations]
        self.context = int(np.ceil(settling_s(high_pass_hz) * rate_hz))

    def __call__(self, time_ns: FloatArray, samples: FloatArray, level: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: ARG002
        """Filter a window."""
        inner = slice(self.context, time_ns.size - self.context)
        result = samples[inner].copy()
        for number, signal in enumerate(self._signals):
            if signal.integrations:
                whole = integrated(samples[:, number], self._rate_hz, signal.integrations, self._high_pass_hz)
                result[:, number] = whole[inner]
        return time_ns[inner], result


class Resampling:
    """Changes the rate by a ratio, new over old (`scipy.signal.resample_poly`, Kaiser window with β = 5.0).

    Columns with angles are resampled as cosine and sine.
    """

    def __init__(self, ratio: Fraction, angles: list[int]) -> None:
        self._up, self._down, self._angles = ratio.numerator, ratio.denominator, angles
        self.columns: slice | list[int] = slice(None)
        self.multiple = self._down
        widest = max(self._up, self._down)
        # The filter of resample_poly extends over ten samples at the lower rate on either side.
        reach = -(-10 * widest // self._up) + 1
        self.context = -(-reach // self._down) * self._down

    def __call__(self, time_ns: FloatArray, samples: FloatArray, level: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Filter a window."""
        up, down = self._up, self._down
        plain = samples - level
        circles = [part(samples[:, self._angles]) for part in (np.cos, np.sin)]
        table = np.hstack([plain, *circles])
        count = -(-(time_ns.size - 2 * self.context) * up // down)
        first = self.context * up // down
        resampled = np.asarray(resample_poly(table, up, down, axis=0, window=("kaiser", 5.0)))[first : first + count]
        width = samples.shape[1]
        result = resampled[:, :width] + level
        cosine, sine = np.split(resampled[:, width:], 2, axis=1)
        result[:, self._angles] = np.mod(np.arctan2(sine, cosine), 2 * np.pi)
        at = self.context + np.arange(count) * (down / up)
        return np.interp(at, np.arange(time_ns.size), time_ns), result
