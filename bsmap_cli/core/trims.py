"""Which part of a trimmed surface is there, and where the thing ends with it."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.polygons import winding_number
from bsmap_cli.model import Array, BSplineSurface


def inside_trims(surface: BSplineSurface, parameters: Array) -> NDArray[np.bool_]:
    """(n,) whether points at parameters (n, 2) belong to the surface: all of them where it has no trims."""
    if not surface.trims:
        return np.ones(len(parameters), dtype=bool)
    return winding_number(parameters, [loop.parameters for loop in surface.trims]) != 0


class Rim(NamedTuple):
    """Part of a surface's open border that follows an edge of the thing: a polyline (k, 3) in map.

    width : metres within which the edge lies about it.
    """

    surface: str
    points: Array
    width: float


def rims_of(surface: BSplineSurface) -> list[Rim]:
    """Rims along the trims of a surface, vertex by vertex."""
    out = []
    for loop in surface.trims:
        if loop.rims is None:
            continue
        # Begins where the width changes, so that no rim goes on beyond the end.
        begin = int(np.argmax(loop.rims != np.roll(loop.rims, 1)))
        widths, at = np.roll(loop.rims, -begin), np.roll(loop.parameters, -begin, axis=0)
        points = evaluate_surface(surface, *np.append(at, at[:1], axis=0).T)
        bounds = [0, *(np.flatnonzero(np.diff(widths)) + 1).tolist(), len(widths)]
        out += [Rim(surface.name, points[a : b + 1], float(widths[a])) for a, b in pairwise(bounds) if widths[a] > 0.0]
    return out
