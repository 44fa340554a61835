"""Closed polygons in the plane: area, which points they wind around, and the same shape with fewer vertices."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.model import Array, IntArray

POINTS_AT_ONCE = 4096


def signed_area(polygons: Array) -> Array:
    """Areas (...) of polygons (..., k, 2), positive where they run counter-clockwise."""
    # From their first vertex: far from the origin the differences of products would lose digits.
    x, y = np.moveaxis(polygons - polygons[..., :1, :], -1, 0)
    return np.asarray(0.5 * np.sum(x * np.roll(y, -1, axis=-1) - np.roll(x, -1, axis=-1) * y, axis=-1))


def winding_number(points: Array, polygons: Sequence[Array]) -> IntArray:
    """How often closed polygons, each (k, 2), wind counter-clockwise around points (n, 2), in sum: (n,).

    Crossings of the ray to the right are counted, upward ones as 1, downward ones as -1 (Hormann and Agathos 2001).
    """
    out = np.zeros(len(points), dtype=np.int64)
    if not len(polygons):
        return out
    a = np.concatenate([np.asarray(p, dtype=float) for p in polygons])
    b = np.concatenate([np.roll(p, -1, axis=0) for p in polygons])
    for start in range(0, len(points), POINTS_AT_ONCE):
        part = slice(start, start + POINTS_AT_ONCE)
        x, y = points[part, :1], points[part, 1:]
        left = (b[:, 0] - a[:, 0]) * (y - a[:, 1]) - (x - a[:, 0]) * (b[:, 1] - a[:, 1])
        up = (a[:, 1] <= y) & (b[:, 1] > y) & (left > 0.0)
        down = (a[:, 1] > y) & (b[:, 1] <= y) & (left < 0.0)
        out[part] = up.sum(axis=1) - down.sum(axis=1)
    return out


def simplify(points: Array, tolerance: float) -> NDArray[np.bool_]:
    """Which vertices of an open line (n, d) stay, so that none is farther off than `tolerance` (Douglas, Peucker)."""
    keep = np.zeros(len(points), dtype=bool)
    keep[[0, -1]] = True
    waiting = [(0, len(points) - 1)]
    while waiting:
        first, last = waiting.pop()
        if last - first < 2:
            continue
        chord = points[last] - points[first]
        between = points[first + 1 : last] - points[first]
        square = float(chord @ chord)
        share = np.clip(between @ chord / square, 0.0, 1.0) if square > 0.0 else np.zeros(len(between))
        distance = np.linalg.norm(between - share[:, None] * chord, axis=1)
        worst = int(np.argmax(distance))
        if distance[worst] > tolerance:
            keep[first + 1 + worst] = True
            waiting += [(first, first + 1 + worst), (first + 1 + worst, last)]
    return keep
