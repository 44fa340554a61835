"""Figures that are written without a screen, and whose bytes depend on nothing but what is drawn."""

from pathlib import Path
from typing import Any

ENDINGS = (".png", ".svg", ".pdf")


def new_figure(width: float, height: float) -> Any:
    """Empty figure, inches, that lays itself out."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save(figure: Any, path: Path, ending: str) -> None:
    """Write the figure to `path` in the format of `ending`, one of ENDINGS; PNG where it is empty."""
    from matplotlib import rc_context

    # The layout's last bits depend on where things lie in memory; they would go into names of an SVG's parts.
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for axes in figure.axes:
        axes.set_position([round(value, 6) for value in axes.get_position(original=True).bounds])
    # Without a date, and without random names of an SVG's parts, the same run gives the same bytes.
    no_date = {".svg": {"Date": None}, ".pdf": {"CreationDate": None}}.get(ending, {})
    with rc_context({"svg.hashsalt": "bsmap"}):
        figure.savefig(path, format=ending.lstrip(".") or "png", dpi=110, metadata=no_date)
