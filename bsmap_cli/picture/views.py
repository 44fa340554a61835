"""Surfaces seen along an axis: outlines, filled shapes, scale; what the pictures of fit and merge share."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.model import Array, BSplineSurface

SIDE = 24
"""Least number of points along the border of a surface without trims, each side."""


class View(NamedTuple):
    """Axes of map that a view shows, x to the right and y up, and its name."""

    name: str
    axes: tuple[int, int]


PLAN, FRONT, SIDEWAYS = View("plan", (0, 1)), View("elevation, along y", (0, 2)), View("elevation, along x", (1, 2))


def colors(count: int) -> list[Any]:
    """Colours (count) in turn, light and dark ones of a hue far apart."""
    from matplotlib import colormaps

    table = colormaps["tab20"].colors  # type: ignore[attr-defined]
    order = [*range(0, 20, 2), *range(1, 20, 2)]
    order = [k for k in order if k not in (14, 15)]  # grey is for what belongs to no face
    return [table[order[k % len(order)]] for k in range(count)]


def outlines(surface: BSplineSurface) -> list[Array]:
    """Closed polygons (k, 3) in map: the trim loops, or the border where there are none."""
    if surface.trims:
        loops = [loop.parameters for loop in surface.trims]
    else:
        s, zero, one = np.arange(SIDE) / SIDE, np.zeros(SIDE), np.ones(SIDE)
        sides = [(s, zero), (one, s), (1 - s, one), (zero, 1 - s)]
        loops = [np.concatenate([np.column_stack(side) for side in sides])]
    return [evaluate_surface(surface, *np.concatenate([loop, loop[:1]]).T) for loop in loops]


def shape(lines: Sequence[Array], view: View) -> Any:
    """Path of all outlines together; holes run the other way and stay open."""
    from matplotlib.path import Path

    return Path.make_compound_path(*(Path(line[:, view.axes], closed=True) for line in lines))


def box(parts: Sequence[Array]) -> Array:
    """(2, 3) lowest and highest coordinates of all points, each part (k, 3), with a margin."""
    points = np.concatenate([np.zeros((0, 3)), *parts])
    if not len(points):
        points = np.zeros((1, 3))
    margin = 0.02 * float(np.max(np.ptp(points, axis=0))) + 0.2
    return np.stack([points.min(axis=0) - margin, points.max(axis=0) + margin])


def set_up(axes: Any, view: View, limits: Array, title: str = "") -> None:
    """Metres, equal scale, limits (2, 3) of the whole scene."""
    i, j = view.axes
    axes.set(xlim=limits[:, i], ylim=limits[:, j], aspect="equal", xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]")
    axes.set_title(title or view.name, fontsize=9)


def heights(limits: Array, width: float, views: Sequence[View], least: float, most: float) -> list[float]:
    """Inches that each view takes where the scene is `width` inches wide, within limits."""
    size = limits[1] - limits[0]
    scale = width / max(size[view.axes[0]] for view in views)
    return [float(np.clip(scale * size[view.axes[1]], least, most)) for view in views]


def round_number(value: float) -> int:
    """1, 2 or 5 times a power of ten, 1 or more, not above the value."""
    power = 10.0 ** np.floor(np.log10(max(value, 1.0)))
    return int(power * max(k for k in (1, 2, 5) if k * power <= max(value, 1.0)))
