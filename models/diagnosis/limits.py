"""A number beside the limit that it exceeds, in a sentence."""

__all__ = ["beyond"]

_DIGITS, _MOST_DIGITS = 3, 15


def beyond(value: float, limit: float) -> tuple[str, str]:
    """Print a value and the limit it is beyond with so many digits that it is beyond the limit as printed, too.

    Examples
    --------
    >>> beyond(7.4449, 5.0)
    ('7.44', '5')
    >>> beyond(20.0004, 20.0)
    ('20.0004', '20')
    """
    for digits in range(_DIGITS, _MOST_DIGITS):
        text = f"{value:.{digits}g}"
        if (float(text) > limit) == (value > limit) and float(text) != limit:
            break
    return text, f"{limit:g}"
