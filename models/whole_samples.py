"""Settings of the window that a machine file leaves out: whole numbers of samples at its rate, below half of it."""

_USABLE = 0.4
"""Part of the sampling rate up to which an anti-aliasing filter lets through."""


def whole(value: float) -> bool:
    """Whether a number is a whole one, but for rounding."""
    return abs(value - round(value)) < 1e-9 * max(1.0, abs(value))


def usual_window(rate_hz: float, usual: dict[str, float], band_hz: tuple[float, float]) -> dict[str, object]:
    """Those of the usual settings that do not go with a sampling rate, as near to them as ones that do.

    Data acquisition often divides a clock by whole numbers (51 200 / 3 Hz), and slow machines are sampled slowly.

    Parameters
    ----------
    usual : dict
        `lag_step_s`, `segment_s` and its multiples `hop_s`, `length_s` and `max_span_s`.
    band_hz : tuple of float
        Usual band of the likelihood.

    Examples
    --------
    >>> usual = {"lag_step_s": 0.001, "segment_s": 2.0, "hop_s": 5.0, "length_s": 60.0, "max_span_s": 90.0}
    >>> usual_window(200.0, usual, (3.0, 150.0))
    {'lag_step_s': 0.005, 'band_hz': (3.0, 80.0)}
    >>> round(usual_window(51200 / 3, usual, (3.0, 150.0))["hop_s"] * 51200 / 3, 6)
    85335.0
    """
    found: dict[str, object] = {}
    if not whole(usual["lag_step_s"] * rate_hz):
        found["lag_step_s"] = max(1, round(usual["lag_step_s"] * rate_hz)) / rate_hz
    if band_hz[1] >= rate_hz / 2 and _USABLE * rate_hz > band_hz[0]:
        found["band_hz"] = (band_hz[0], _USABLE * rate_hz)
    half_s = usual["segment_s"] / 2
    lengths = ("segment_s", "hop_s", "length_s", "max_span_s")
    if not all(whole(usual[name] * rate_hz) for name in lengths):
        samples = max(1, round(half_s * rate_hz))
        found |= {name: round(usual[name] / half_s) * samples / rate_hz for name in lengths}
    return found
