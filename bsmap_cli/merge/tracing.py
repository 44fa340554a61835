"""Curves in which two surfaces cross, traced along what data sets saw of their creases, or along both outlines."""

from collections.abc import Mapping, Sequence

import numpy as np

from bsmap_cli.core.polygons import simplify
from bsmap_cli.merge.curves import APART, BESIDE, Curve, FacePair, Shapes, locate, onto, place, union
from bsmap_cli.merge.shapes import Shape, SplineShape, above, flattened
from bsmap_cli.model import Array

FINE = 0.01
"""Metres between points of a curve before it is simplified."""
TOLERANCE = 0.001
"""Metres by which a simplified curve may leave the crossing of its surfaces."""
ON = 0.002
"""Metres off a surface within which a point of a curve is on it: where surfaces touch, they hardly cross."""
STRAIGHT = 0.005
"""Metres by which the creases of a straight curve leave their line."""
BENT_REACH = 0.1
"""Metres by which a bent curve goes on straight beyond its ends: around a pillar both ends come near each other."""
SKEW = 0.3
"""Least sine of the angle between two faces of which no data set saw the crease."""
UNEVEN = 0.01
"""Metres by which an outline beside a crease that nobody saw may be farther off than where it is nearest."""
EVERYWHERE = np.array([[-np.inf, np.inf]])


def curves_of(sides: Mapping[FacePair, Array], shapes: Shapes) -> list[Curve]:
    """Curves of all pairs of faces that cross.

    sides : (k, 2, 3) ends of the segments of data sets' creases, by their faces.
    """
    found = (_traced(pair, sides[pair], shapes) for pair in sorted(sides))
    return [curve for curve in found if curve is not None]


def _traced(pair: FacePair, sides: Array, shapes: Shapes) -> Curve | None:
    points = sides.reshape(-1, 3)
    both = [shapes[face] for face in pair]
    middle, direction = _main_line(points)
    along = (points - middle) @ direction
    if np.linalg.norm(points - middle - along[:, None] * direction, axis=1).max() > STRAIGHT:
        along = _around(both, points)
    order, first = np.unique(np.round(along, 4), return_index=True)
    curve = _through(pair, order, points[first], both)
    if curve is None:
        return None
    at = np.sort(locate(curve, points)[0].reshape(-1, 2), axis=1)
    _, direction = _main_line(curve.points)
    straight = np.linalg.norm(np.cross(curve.points - curve.points[0], direction), axis=1).max() < BESIDE
    return curve._replace(seen=union(at, APART), reach=np.inf if straight else BENT_REACH)


def _around(shapes: Sequence[Shape], points: Array) -> Array:
    """(n,) metres about along a bent curve: by the parameter of the bent surface that changes most along it."""
    bent = next((shape for shape in shapes if isinstance(shape, SplineShape)), shapes[0])
    metres = flattened(bent, points)
    return np.asarray(metres[:, int(np.argmax(np.ptp(metres, axis=0)))])


def _through(pair: FacePair, along: Array, points: Array, shapes: Sequence[Shape]) -> Curve | None:
    """Curve on both surfaces near points (n, 3) in the order of `along` (n,); None where they do not cross there."""
    at = np.linspace(along[0], along[-1], max(2, int(np.ceil((along[-1] - along[0]) / FINE)) + 1))
    rough = np.column_stack([np.interp(at, along, points[:, axis]) for axis in range(3)])
    placed = onto(shapes, rough)
    placed = placed[np.max([np.abs(above(shape, placed)[0]) for shape in shapes], axis=0) < ON]
    if len(placed) < 2:
        return None
    placed = placed[simplify(placed, TOLERANCE)]
    t = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(placed, axis=0), axis=1)))
    placed, t = placed[np.append(True, np.diff(t) > 0.0)], t[np.append(True, np.diff(t) > 0.0)]
    return Curve(pair, placed, t, EVERYWHERE) if len(t) > 1 else None


def unseen_curve(
    pair: FacePair, corners: Array, outlines: Mapping[int, Sequence[Array]], shapes: Shapes, gap: float
) -> Curve | None:
    """Curve through corners (k, 3) in which two faces end side by side, though no data set saw their crease.

    Scans that are parallel to an edge miss it: each face then ends at the last scan before it. And where faces touch
    without an angle nothing but two corners, with floor and ceiling, tells where one ends and the other begins. None
    where not both outlines come near the same part of the line, together within `gap`.
    """
    direction = np.cross(*(above(shapes[face], corners[:1])[1][0] for face in pair))
    if np.linalg.norm(direction) < SKEW:
        direction = corners[np.argmax(np.linalg.norm(corners - corners[0], axis=1))] - corners[0]
        if np.linalg.norm(direction) < gap:
            return None
    ends = np.array([corners[0], corners[0] + direction / np.linalg.norm(direction)])
    line = Curve(pair, ends, np.array([0.0, 1.0]), EVERYWHERE)
    both, off = zip(*(_beside(line, outlines[face], gap) for face in pair), strict=True)
    if not all(len(intervals) for intervals in both) or sum(off) > gap:
        return None
    low, high = (f([f(intervals) for intervals in both]) for f in (np.min, np.max))
    shared = min(intervals.max() for intervals in both) - max(intervals.min() for intervals in both)
    if shared < APART:
        return None
    curve = _through(pair, np.array([low, high]), place(line, np.array([low, high]), shapes), [shapes[f] for f in pair])
    beside = max(gap / 2.0, max(off) + UNEVEN)
    return None if curve is None else curve._replace(seen=curve.t[[0, -1]][None], beside=beside)


def _beside(line: Curve, loops: Sequence[Array], distance: float) -> tuple[Array, float]:
    """(k, 2) intervals of the line's length along which sides of loops run, within a distance, and the least one."""
    found, off = [np.zeros((0, 2))], distance
    for loop in loops:
        t, away = locate(line, loop)
        ends = np.sort(np.column_stack([t, np.roll(t, -1)]), axis=1)
        farther = np.maximum(away, np.roll(away, -1))
        near = (farther < distance) & (ends[:, 1] - ends[:, 0] > APART)
        found.append(ends[near])
        off = min(off, float(farther[near].min(initial=distance)))
    return np.concatenate(found), off


def _main_line(points: Array) -> tuple[Array, Array]:
    """Middle (3,) and direction (3,) of the straight line through points (n, 3), pointing up or along x."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
    direction = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    return middle, np.asarray(direction * np.sign(direction[np.argmax(np.abs(direction))]))
