"""Curves in which faces of the map meet, and what of them the data sets saw."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.merge.shapes import Shape, above
from bsmap_cli.model import Array

SETTLED = 1e-9
"""Metres; a step below this is the last one."""
PARALLEL = 0.1
"""Of singular values of the surfaces' normals, the smallest over the largest, below which they count as parallel."""
FARTHEST = 0.05
"""Metres by which a point is moved onto surfaces at most."""
APART = 0.02
"""Metres between two pieces of a curve that are one."""
BESIDE = 0.03
"""Metres from a curve within which an outline runs along it. Where one data set's outline hides another's crease, it
lies up to 26 mm off (rooms and corridors of known truth)."""

FacePair = tuple[int, int]
Shapes = Mapping[int, Shape]


class Curve(NamedTuple):
    """Where two faces of the map meet.

    points : (n, 3) of a polyline in map.  t : (n,) its length up to them, metres.  seen : (k, 2) ascending intervals of
    t in which creases of data sets ran.  beside : metres from it within which an outline runs along it.
    reach : metres by which it goes on straight beyond its ends.
    """

    pair: FacePair
    points: Array
    t: Array
    seen: Array
    beside: float = BESIDE
    reach: float = np.inf


def onto(shapes: Sequence[Shape], points: Array, farthest: float = FARTHEST) -> Array:
    """Points (n, 3) moved the shortest way onto all surfaces at once; those that would go far stay."""
    out = points.copy()
    for _ in range(4):
        found = [above(shape, out) for shape in shapes]
        heights = np.stack([h for h, _ in found], axis=1)
        normals = np.stack([n for _, n in found], axis=1)
        steps = _steps(normals, heights)
        out = out - steps
        if np.abs(steps).max(initial=0.0) < SETTLED:
            break
    far = np.linalg.norm(out - points, axis=1) > farthest
    return np.where(far[:, None], points, out)


def _steps(normals: Array, heights: Array) -> Array:
    """(n, 3) shortest ways along unit normals (n, k, 3) that change all heights (n, k).

    Surfaces that are nearly parallel do not tell where along them they meet.
    """
    if normals.shape[1] != 2:
        return np.asarray((np.linalg.pinv(normals, rcond=PARALLEL) @ heights[..., None])[..., 0])
    # Of two the singular values are the roots of 1 + c and 1 - c, of the sum and the difference of the normals.
    (a, b), (g, h) = normals.transpose(1, 0, 2), heights.T
    c = np.sum(a * b, axis=1)
    plus, minus = 1.0 + c, 1.0 - c
    least = PARALLEL**2 * np.maximum(plus, minus)
    by_sum = np.divide(g + h, 2.0 * plus, out=np.zeros(len(c)), where=plus > least)
    by_difference = np.divide(g - h, 2.0 * minus, out=np.zeros(len(c)), where=minus > least)
    return np.asarray((by_sum + by_difference)[:, None] * a + (by_sum - by_difference)[:, None] * b)


def union(intervals: Array, gap: float) -> Array:
    """Union of intervals (k, 2), ascending and disjoint; those with less than `gap` between them are one."""
    intervals = intervals[np.lexsort(intervals.T[::-1])]
    reached = np.maximum.accumulate(intervals[:, 1])
    starts = np.flatnonzero(np.append(True, intervals[1:, 0] > reached[:-1] + gap))
    return np.column_stack([intervals[starts, 0], reached[np.append(starts[1:], len(intervals)) - 1]])


def covered(intervals: Array, low: float, high: float, gap: float) -> bool:
    """Whether one of the intervals (k, 2) holds all from `low` to `high`, but for `gap` at each end."""
    return bool(np.any((intervals[:, 0] <= low + gap) & (intervals[:, 1] >= high - gap)))


def touched(intervals: Array, low: float, high: float, gap: float) -> bool:
    """Whether one of the intervals (k, 2) has anything from `low` to `high`, or comes nearer than `gap`."""
    return bool(np.any((intervals[:, 0] < high + gap) & (intervals[:, 1] > low - gap)))


def locate(curve: Curve, points: Array) -> tuple[Array, Array]:
    """Length t (n,) along the curve of the nearest places to points (n, 3), and the distances (n,).

    Beyond its ends the curve goes on straight, as far as it reaches.
    """
    starts, ways = curve.points[:-1], np.diff(curve.points, axis=0)
    lengths = np.linalg.norm(ways, axis=1)
    along = np.einsum("nkd,kd->nk", points[:, None] - starts, ways / lengths[:, None])
    low, high = np.zeros(len(ways)), lengths.copy()
    low[0], high[-1] = -curve.reach, lengths[-1] + curve.reach
    along = np.clip(along, low, high)
    nearest = starts + along[..., None] * (ways / lengths[:, None])
    distance = np.linalg.norm(points[:, None] - nearest, axis=2)
    best = np.argmin(distance, axis=1)
    row = np.arange(len(points))
    return curve.t[best] + along[row, best], distance[row, best]


def place(curve: Curve, t: Array, shapes: Shapes) -> Array:
    """Points (n, 3) on the curve, and on both faces, at lengths t (n,)."""
    segment = np.clip(np.searchsorted(curve.t, t, side="right") - 1, 0, len(curve.t) - 2)
    share = (t - curve.t[segment]) / (curve.t[segment + 1] - curve.t[segment])
    points = curve.points[segment] + share[:, None] * (curve.points[segment + 1] - curve.points[segment])
    return onto([shapes[face] for face in curve.pair], points)


def between(curve: Curve, start: float, end: float) -> Array:
    """Points (k, 3) in which the polyline bends between two lengths, start < end."""
    bends: NDArray[np.bool_] = (curve.t > start) & (curve.t < end)
    bends[[0, -1]] = False
    return curve.points[bends]
