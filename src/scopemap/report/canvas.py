"""Figures of benchmarks by matplotlib, which scopemap-bench brings: without a display, without any state of its own."""

from __future__ import annotations

import textwrap
from typing import TYPE_CHECKING

from scopemap.errors import SettingsError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ESTIMATE_COLOUR = "#1a9850"
TRUTH_COLOUR = "#d73027"
_HEADLINE_POINTS = 11
_LETTERS_PER_INCH = 12


def new_figure(width_in: float, height_in: float) -> Figure:
    """Return an empty figure of this size in inches, 100 dots per inch. Raises `SettingsError` without matplotlib."""
    # Imported here, so that importing the package stays fast; a Figure with its own canvas keeps no global state.
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError:
        raise SettingsError("figures of benchmarks need matplotlib: pip install -e bench") from None
    figure = Figure(figsize=(width_in, height_in), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def headline(figure: Figure, text: str) -> None:
    """Write a title over the whole figure, in as many lines as its width asks for."""
    width = int(_LETTERS_PER_INCH * figure.get_figwidth())
    lines = len(textwrap.wrap(text, width))
    # Lines of about the same length: no word alone in the last one.
    even = min(width, len(text) // lines + 12)
    figure.suptitle(textwrap.fill(text, even), fontsize=_HEADLINE_POINTS)
