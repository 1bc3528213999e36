"""How the report's pictures look, and how they get into the page: SVG inside the HTML, in the page's own colours."""

import re
from collections.abc import Callable
from io import StringIO

from markupsafe import Markup, escape
from matplotlib import style
from matplotlib.figure import Figure

__all__ = ["BAND", "COLOURS", "GREY", "INK", "WIDTH_IN", "inline_svg"]

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""After Okabe and Ito: told apart with any colour vision."""
INK, GREY, BAND = "#1c2530", "#66727f", "#edf2f6"
WIDTH_IN = 10.0
"""Width of every picture, so that letters are of one size on the page."""

_GRID = "#dde2e6"
_VARIABLES = {INK: "--ink", GREY: "--grey", _GRID: "--line", BAND: "--band"} | {
    colour: f"--c{number}" for number, colour in enumerate(COLOURS)
}
"""Colours and the properties of the page that replace them: light, dark and on paper."""

_STYLE = {
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.edgecolor": GREY,
    "axes.facecolor": "none",
    "axes.formatter.useoffset": False,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "figure.facecolor": "none",
    "grid.color": _GRID,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "text.color": INK,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "svg.fonttype": "path",  # no font is needed to look at it
    "svg.hashsalt": "rotorwatch",  # the same numbers make the same page
}
_NO_METADATA = dict.fromkeys(("Creator", "Date", "Format", "Type"))


def inline_svg(name: str, label: str, paint: Callable[[], Figure | None]) -> Markup | None:
    """Draw a picture in the house style, as an element of an HTML page.

    Parameters
    ----------
    name : str
        Unique on the page: every identifier in the picture begins with it.
    label : str
        What it shows, for those who cannot see it.
    paint : callable
        Makes the figure, of width `WIDTH_IN`, or None if there is nothing to draw.

    Returns
    -------
    Markup or None
    """
    written = StringIO()
    with style.context(["default", _STYLE]):
        figure = paint()
        if figure is None:
            return None
        figure.savefig(written, format="svg", metadata=_NO_METADATA)
    text = written.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>|<style .*?</style>", "", text, flags=re.DOTALL)
    box = re.search(r'viewBox="[^"]*"', text)
    assert box is not None  # noqa: S101  # matplotlib always writes one
    text = f'<svg {box[0]} role="img" aria-label="{escape(label)}">' + text[text.index(">") + 1 :]
    text = re.sub(r'\bid="', f'id="{name}-', text)
    text = re.sub(r'(?:xlink:)?href="#', f'href="#{name}-', text)
    text = text.replace("url(#", f"url(#{name}-")
    return Markup(re.sub(r"#[0-9a-f]{6}\b", lambda found: _coloured(found[0]), text))  # noqa: S704  # drawn, not given


def _coloured(colour: str) -> str:
    return f"var({_VARIABLES[colour]})" if colour in _VARIABLES else colour
