"""Rims of faces of the map: open borders along which data sets saw that the thing has an edge.

Every data set brackets the edge between two beams. What is left open of the faces' union runs along the farthest of
them; the rim runs in their middle, straight as far as all keep near it. Places are those in the face's base, metres.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bsmap_cli.core.lines import straight_line
from bsmap_cli.core.polygons import signed_area
from bsmap_cli.merge.outlines import Member
from bsmap_cli.merge.rings import Ring
from bsmap_cli.merge.shapes import Shape, flattened_ring, placed
from bsmap_cli.model import Array, IntArray

FINE = 0.02
"""Metres between places at which borders and rims are compared."""
NEAR, SHORT = 0.06, 0.2
"""Metres from a rim of a data set within which the border of the union follows it: as wide as brackets are; and of a
way that leaves it, as where a single scan stands out.
"""
ALONG = 0.9
"""Cosine between a border and a rim that it follows."""
OFF = 0.02
"""Metres by which borders may leave a straight rim inwards."""
LEAST = 0.05
"""Metres; shorter rims are none."""
ROUNDS, LEAST_OFF = 8, 0.1
"""Of the weights of brackets, and the share of a bracket off the line below which all weigh the same."""
CROSSING = 0.3
"""Sine of the angle between two rims that meet in their crossing."""


class _Seen(NamedTuple):
    """Places (n, 2) on rims of data sets, unit directions (n, 2), the face on their left, widths (n,) of brackets."""

    places: Array
    ways: Array
    widths: Array
    tree: cKDTree


class _Line(NamedTuple):
    """A place (2,) and a unit direction (2,)."""

    middle: Array
    way: Array

    def foot(self, places: Array) -> Array:
        """Nearest places (..., 2) on the line."""
        return np.asarray(self.middle + ((places - self.middle) @ self.way)[..., None] * self.way)

    def right(self, places: Array) -> Array:
        """Metres (...) by which places lie to the right of the line."""
        return np.asarray((places - self.middle) @ np.array([self.way[1], -self.way[0]]))


def along_rims(rings: Sequence[Ring], members: Iterable[Member], shape: Shape) -> list[Ring]:
    """Rings of a face, led along the rims that its members tell.

    members : of the face, in its place.  shape : of the face.
    """
    seen = _seen(members, shape)
    if seen is None:
        return list(rings)
    flat = [flattened_ring(shape, ring.points) for ring in rings]
    if _clockwise(flat):
        seen = seen._replace(ways=-seen.ways)
    return [_led(ring, places, seen, shape) for ring, places in zip(rings, flat, strict=True)]


def _clockwise(loops: Sequence[Array]) -> bool:
    """Whether loops (k, 2) run around a face clockwise: its parameters may be mirrored."""
    return sum(float(signed_area(loop)) for loop in loops) < 0.0


def _seen(members: Iterable[Member], shape: Shape) -> _Seen | None:
    """Places on the rims of all members; None where there is none."""
    sides, widths = [np.zeros((0, 2, 2))], [np.zeros(0)]
    for member in members:
        if any(rims.any() for rims in member.rims):
            flat = [flattened_ring(shape, corners) for corners in member.corners]
            ends = np.concatenate([np.stack([loop, np.roll(loop, -1, axis=0)], axis=1) for loop in flat])
            rims = np.concatenate(member.rims)
            sides.append(ends[rims > 0.0][:, :: -1 if _clockwise(flat) else 1])
            widths.append(rims[rims > 0.0])
    starts, ends = np.concatenate(sides).transpose(1, 0, 2)
    lengths = np.linalg.norm(ends - starts, axis=1)
    count = np.where(lengths > 0.0, np.maximum(1, np.rint(lengths / FINE)), 0).astype(np.int64)
    of = np.repeat(np.arange(len(count)), count)
    share = (np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[of]
    places = starts[of] + share[:, None] * (ends - starts)[of]
    ways = ((ends - starts) / np.maximum(lengths, 1e-12)[:, None])[of]
    return _Seen(places, ways, np.concatenate(widths)[of], cKDTree(places)) if len(of) else None


def _led(ring: Ring, flat: Array, seen: _Seen, shape: Shape) -> Ring:
    """A ring, its vertices at places (k, 2), whose open sides beside rims run along these; as it was where hardly
    anything of it would be left.
    """
    led = _led_along(ring, flat, seen, shape)
    return led if len(led.points) > 2 else ring


def _led_along(ring: Ring, flat: Array, seen: _Seen, shape: Shape) -> Ring:
    points, flat, edges = _divided(ring, flat)
    follows = _follow(flat, edges, seen)
    if not follows.any():
        return ring
    # Begins where a rim does, so that none goes on beyond the end; the first vertex is the last one, too.
    begin = int(np.argmax(follows & ~np.roll(follows, 1)))
    edges, follows = np.roll(edges, -begin), np.roll(follows, -begin)
    held = (edges >= 0) | (np.roll(edges, 1) >= 0)
    around = np.arange(begin, begin + len(edges) + 1) % len(edges)
    points, flat = points[around], flat[around]
    parts: list[Ring] = []
    for a, b in pairwise([0, *(np.flatnonzero(np.diff(follows)) + 1).tolist(), len(follows)]):
        border = flat[a : b + 1]
        if follows[a] and np.linalg.norm(np.diff(border, axis=0), axis=1).sum() >= LEAST:
            rim, widths = _rim(border, seen)
            rim_points, widths = _held(placed(shape, rim), widths, points[[a, b]], held[[a, b % len(held)]])
            # Where a rim ends, the next side begins.
            points[b] = rim_points[-1]
            parts.append(Ring(rim_points[:-1], np.full(len(widths), -1), widths))
        else:
            parts.append(Ring(points[a:b].copy(), edges[a:b], np.zeros(b - a)))
    return Ring(*(np.concatenate(of) for of in zip(*parts, strict=True)))


def _divided(ring: Ring, flat: Array) -> tuple[Array, Array, IntArray]:
    """Points (n, 3), places (n, 2) and edges (n,) of a ring with vertices all along its open sides."""
    ways = np.roll(flat, -1, axis=0) - flat
    count = np.where(ring.edges < 0, np.maximum(1, np.ceil(np.linalg.norm(ways, axis=1) / FINE)), 1).astype(np.int64)
    of = np.repeat(np.arange(len(count)), count)
    share = ((np.arange(len(of)) - np.repeat(np.cumsum(count) - count, count)) / count[of])[:, None]
    points = ring.points[of] + share * (np.roll(ring.points, -1, axis=0) - ring.points)[of]
    return points, flat[of] + share * ways[of], ring.edges[of]


def _follow(flat: Array, edges: IntArray, seen: _Seen) -> NDArray[np.bool_]:
    """Which open sides (k,) run along a rim, or leave it for a short way on which they stay near it."""
    ways = np.roll(flat, -1, axis=0) - flat
    lengths = np.linalg.norm(ways, axis=1)
    near = seen.tree.query_ball_point(flat + ways / 2.0, NEAR)
    turned = [
        (seen.ways[some] @ way).max(initial=-np.inf)
        for some, way in zip(near, ways / np.maximum(lengths, 1e-12)[:, None], strict=True)
    ]
    beside = np.isfinite(turned) & (edges < 0)
    follows = (np.array(turned) > ALONG) & beside
    starts = np.flatnonzero(follows != np.roll(follows, 1))
    for a, b in pairwise([*starts.tolist(), *(starts[:1] + len(follows)).tolist()]):
        side = np.arange(a, b) % len(follows)
        if not follows[side[0]] and beside[side].all() and lengths[side].sum() < SHORT:
            follows[side] = True
    return follows


def _rim(border: Array, seen: _Seen) -> tuple[Array, Array]:
    """Vertices (j, 2) of the rim along a border (k, 2), and metres (j - 1,) of brackets; 0 where none goes along."""
    bounds = _bends(border, 0, len(border) - 1, seen)
    lines, brackets = zip(*(_through(border[a : b + 1], seen) for a, b in pairwise(bounds)), strict=True)
    joints = (_joint(lines[k], lines[k + 1], border[at]) for k, at in enumerate(bounds[1:-1]))
    out = np.array([lines[0].foot(border[0]), *joints, lines[-1].foot(border[-1])])
    known = np.array([len(widths) > 0 for widths in brackets])
    return out, known * (float(np.median(np.concatenate(brackets))) if known.any() else 0.0)


def _bends(border: Array, first: int, last: int, seen: _Seen) -> list[int]:
    """Vertices, ascending, between which a border runs along straight rims, or is straight."""
    part, chord = border[first : last + 1], border[last] - border[first]
    line, widths = _through(part, seen)
    out = line.right(part)
    # A single data set may have seen too much, but where all leave something open it is open.
    if last - first < 2 or (out.min() > -OFF and out.max() < (NEAR if len(widths) else OFF)):
        return [first, last]
    away = np.abs((part - border[first]) @ np.array([chord[1], -chord[0]]))
    cut = first + min(max(int(np.argmax(away)), 1), len(part) - 2)
    return _bends(border, first, cut, seen)[:-1] + _bends(border, cut, last, seen)


def _through(border: Array, seen: _Seen) -> tuple[_Line, Array]:
    """The line through what data sets saw of a rim along a border (k, 2), and widths of the brackets; where nothing of
    it goes the same way, through the border itself, and none.
    """
    own = _middle_line(border, np.full(len(border), OFF), border[-1] - border[0])
    lists = seen.tree.query_ball_point(border, NEAR)
    near = np.unique(np.concatenate([np.array(some, dtype=np.int64) for some in lists]))
    near = near[seen.ways[near] @ own.way > ALONG]
    if len(near) < 2:
        return own, np.zeros(0)
    return _middle_line(seen.places[near], seen.widths[near], own.way), seen.widths[near]


def _middle_line(places: Array, widths: Array, way: Array) -> _Line:
    """The line, about along `way` (2,), through brackets of places (k, 2), nearest to most: few that lie aside move it
    little.
    """
    weights = 1.0 / widths**2
    line = _Line(*straight_line(places, weights))
    for _ in range(ROUNDS):
        off = np.maximum(np.abs(line.right(places)) / widths, LEAST_OFF)
        line = _Line(*straight_line(places, weights / off))
    return line if line.way @ way >= 0.0 else _Line(line.middle, -line.way)


def _joint(one: _Line, other: _Line, place: Array) -> Array:
    """Where two lines meet near a place (2,)."""
    halfway = (one.foot(place) + other.foot(place)) / 2.0
    ways = np.column_stack([one.way, -other.way])
    if abs(np.linalg.det(ways)) < CROSSING:
        return halfway
    crossing = one.middle + np.linalg.solve(ways, other.middle - one.middle)[0] * one.way
    return crossing if np.linalg.norm(crossing - place) < NEAR + OFF else halfway


def _held(rim: Array, widths: Array, ends: Array, held: NDArray[np.bool_]) -> tuple[Array, Array]:
    """The rim (j, 3) and its widths (j - 1,), begun and ended at the ends (2, 3) of the border where creases hold them.

    The way from such an end to a rim that lies aside follows nothing.
    """
    for side in (0, -1):
        if held[side]:
            end = ends[side]
            if np.linalg.norm(rim[side] - end) < OFF:
                rim[side] = end
            else:
                rim = np.concatenate([end[None], rim] if side == 0 else [rim, end[None]])
                widths = np.append(0.0, widths) if side == 0 else np.append(widths, 0.0)
    return rim, widths
