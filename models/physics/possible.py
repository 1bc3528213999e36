"""What physics allows a relative change to be: a number beyond that is no reading, whatever computed it."""

__all__ = ["impossible"]

_LEAST = -1.0
"""Nothing that is positive by nature can lose all it has and still be there to be read."""


def impossible(change: float, quantity: str) -> str:
    """Why a relative change cannot be; empty if it can.

    Parameters
    ----------
    change : float
        Relative change of something that is positive by nature: a mass, a stiffness, a damping, a gain, a length.
    quantity : str
        What it is, in a word or two.

    Examples
    --------
    >>> impossible(-0.4, "mass")
    ''
    >>> impossible(-4.7, "mass")
    'reads as −470 %, which is impossible: a mass cannot fall by 100 % or more'
    """
    if change > _LEAST:
        return ""
    size = f"{-100 * change:.0f}"
    return f"reads as −{size} %, which is impossible: a {quantity} cannot fall by 100 % or more"
