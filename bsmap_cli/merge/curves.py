"""Curves in which faces of the map meet, and what of them the data sets saw."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.heights import HeightField, offset
from bsmap_cli.model import Array

SETTLED = 1e-9
"""Metres; a step below this is the last one."""
FARTHEST = 0.05
"""Metres by which a point is moved onto surfaces at most."""
APART = 0.02
"""Metres between two pieces of a curve that are one."""
STRAIGHT = 0.005
"""Metres by which a crease leaves its straight line at most, to be joined with others of the same two faces."""

BESIDE = 0.01
"""Metres from a curve within which an outline runs along it."""
SKEW = 0.3
"""Least sine of the angle between two faces of which no data set saw the crease."""

EVERYWHERE = np.array([[-np.inf, np.inf]])

FacePair = tuple[int, int]
Fields = Mapping[int, HeightField]


class Curve(NamedTuple):
    """Where two faces of the map meet.

    points : (n, 3) of a polyline in map.  t : (n,) its length up to them, metres.  seen : (k, 2) ascending intervals of
    t in which creases of data sets ran.  beside : metres from it within which an outline runs along it.
    """

    pair: FacePair
    points: Array
    t: Array
    seen: Array
    beside: float = BESIDE


def onto(fields: Sequence[HeightField], points: Array, farthest: float = FARTHEST) -> Array:
    """Points (n, 3) moved the shortest way onto all surfaces at once; those that would go far stay."""
    out = points.copy()
    for _ in range(4):
        found = [offset(field, out) for field in fields]
        heights = np.stack([h for h, _ in found], axis=1)
        normals = np.stack([n for _, n in found], axis=1)
        # Surfaces that are nearly parallel do not tell where along them they meet.
        steps = np.linalg.pinv(normals, rcond=0.1) @ heights[..., None]
        out = out - steps[..., 0]
        if np.abs(steps).max(initial=0.0) < SETTLED:
            break
    far = np.linalg.norm(out - points, axis=1) > farthest
    return np.where(far[:, None], points, out)


def curves_of(sides: Mapping[FacePair, Array], fields: Fields) -> list[Curve]:
    """Curves of all pairs of faces.  sides : (k, 2, 3) ends of the segments of data sets' creases, by their faces."""
    return [_straight_curve(pair, sides[pair], fields) for pair in sorted(sides)]


def _straight_curve(pair: FacePair, sides: Array, fields: Fields) -> Curve:
    middle, direction = main_line(sides.reshape(-1, 3))
    at = np.sort((sides - middle) @ direction, axis=1)
    ends = middle + np.array([at.min(), at.max()])[:, None] * direction
    points = onto([fields[face] for face in pair], ends)
    seen = union(at - at.min(), APART)
    return Curve(pair, points, np.array([0.0, np.linalg.norm(points[1] - points[0])]), seen)


def unseen_curve(
    pair: FacePair, point: Array, outlines: Mapping[int, Sequence[Array]], fields: Fields, gap: float
) -> Curve | None:
    """Curve through a corner (3,) in which two faces end side by side, though no data set saw their crease.

    Scans that are parallel to an edge miss it: each face then ends at the last scan before it. None where not both
    outlines come within half of `gap` of the same part of the line in which the faces cross.
    """
    normals = [offset(fields[face], point[None])[1][0] for face in pair]
    direction = np.cross(*normals)
    if np.linalg.norm(direction) < SKEW:
        return None
    line = Curve(
        pair, np.array([point, point + direction / np.linalg.norm(direction)]), np.array([0.0, 1.0]), EVERYWHERE
    )
    both = [_beside(line, outlines[face], gap / 2.0) for face in pair]
    if not all(len(intervals) for intervals in both):
        return None
    low, high = (f([f(intervals) for intervals in both]) for f in (np.min, np.max))
    shared = min(intervals.max() for intervals in both) - max(intervals.min() for intervals in both)
    if shared < APART:
        return None
    points = place(line, np.array([low, high]), fields)
    length = float(np.linalg.norm(points[1] - points[0]))
    return Curve(pair, points, np.array([0.0, length]), np.array([[0.0, length]]), gap / 2.0)


def _beside(line: Curve, loops: Sequence[Array], distance: float) -> Array:
    """(k, 2) intervals of the line's length along which sides of loops run, within a distance."""
    found = []
    for loop in loops:
        t, off = locate(line, loop)
        ends = np.sort(np.column_stack([t, np.roll(t, -1)]), axis=1)
        near = np.maximum(off, np.roll(off, -1)) < distance
        found.append(ends[near & (ends[:, 1] - ends[:, 0] > APART)])
    return np.concatenate(found)


def main_line(points: Array) -> tuple[Array, Array]:
    """Middle (3,) and direction (3,) of the straight line through points (n, 3), pointing up or along x."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    direction = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    return middle, np.asarray(direction * np.sign(direction[np.argmax(np.abs(direction))]))


def straight(points: Array) -> bool:
    """Whether points (n, 3) lie on one line."""
    middle, direction = main_line(points)
    off = (points - middle) - ((points - middle) @ direction)[:, None] * direction
    return bool(np.linalg.norm(off, axis=1).max() < STRAIGHT)


def union(intervals: Array, gap: float) -> Array:
    """Union of intervals (k, 2), ascending and disjoint; those with less than `gap` between them are one."""
    intervals = intervals[np.lexsort(intervals.T[::-1])]
    reached = np.maximum.accumulate(intervals[:, 1])
    starts = np.flatnonzero(np.append(True, intervals[1:, 0] > reached[:-1] + gap))
    return np.column_stack([intervals[starts, 0], reached[np.append(starts[1:], len(intervals)) - 1]])


def covered(intervals: Array, low: float, high: float, gap: float) -> bool:
    """Whether one of the intervals (k, 2) holds all from `low` to `high`, but for `gap` at each end."""
    return bool(np.any((intervals[:, 0] <= low + gap) & (intervals[:, 1] >= high - gap)))


def locate(curve: Curve, points: Array) -> tuple[Array, Array]:
    """Length t (n,) along the curve of the nearest places to points (n, 3), and the distances (n,).

    Beyond its ends the curve goes on straight.
    """
    starts, ways = curve.points[:-1], np.diff(curve.points, axis=0)
    lengths = np.linalg.norm(ways, axis=1)
    along = np.einsum("nkd,kd->nk", points[:, None] - starts, ways / lengths[:, None])
    low, high = np.zeros(len(ways)), lengths.copy()
    low[0], high[-1] = -np.inf, np.inf
    along = np.clip(along, low, high)
    nearest = starts + along[..., None] * (ways / lengths[:, None])
    distance = np.linalg.norm(points[:, None] - nearest, axis=2)
    best = np.argmin(distance, axis=1)
    row = np.arange(len(points))
    return curve.t[best] + along[row, best], distance[row, best]


def place(curve: Curve, t: Array, fields: Fields) -> Array:
    """Points (n, 3) on the curve, and on both faces, at lengths t (n,)."""
    segment = np.clip(np.searchsorted(curve.t, t, side="right") - 1, 0, len(curve.t) - 2)
    share = (t - curve.t[segment]) / (curve.t[segment + 1] - curve.t[segment])
    points = curve.points[segment] + share[:, None] * (curve.points[segment + 1] - curve.points[segment])
    return onto([fields[face] for face in curve.pair], points)


def between(curve: Curve, start: float, end: float) -> Array:
    """Points (k, 3) in which the polyline bends between two lengths, start < end."""
    bends: NDArray[np.bool_] = (curve.t > start) & (curve.t < end)
    bends[[0, -1]] = False
    return curve.points[bends]
