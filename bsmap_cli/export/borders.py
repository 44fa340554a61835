"""Borders of trimmed surfaces as polygons of points: along creases both surfaces get the very same points."""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.model import Array, BSplineSurface, Crease, IntArray, TrimLoop

FARTHEST = 0.05
"""Metres from a side of a trim loop to its crease; what is farther off does not run along it."""


class Border(NamedTuple):
    """Closed polygon around a surface or a hole.

    parameters : (k, 2).  points : (k, 3) in map.  shared : (k,) whether they are points of a crease.
    """

    parameters: Array
    points: Array
    shared: NDArray[np.bool_]


class _Sides(NamedTuple):
    """Sides of a trim loop: starts and ends (k, 2), and which segment of which crease (k,) each runs along, or -1.

    forward : (k,) whether it runs from the segment's first point to its last.
    """

    starts: Array
    ends: Array
    crease: IntArray
    segment: IntArray
    forward: NDArray[np.bool_]


class _Segment(NamedTuple):
    """Segment of a crease as one surface has it: parameters (2,) of its first and its last point."""

    surface: int
    first: Array
    last: Array


def borders(
    surfaces: Sequence[BSplineSurface], creases: Sequence[Crease], steps: Sequence[Array]
) -> list[list[Border]]:
    """Of each surface the polygons of its trim loops, their sides divided.

    Points between the ends of a crease's segment are decided once, by all surfaces that have it.

    Parameters
    ----------
    steps : of each surface (2,) the longest side in u and in v that follows it well enough.
    """
    sides = [[_sides_of(surface, loop, creases) for loop in surface.trims] for surface in surfaces]
    between = _between(surfaces, creases, steps, sides)
    return [
        [_border(surface, some, step, creases, between) for some in loops]
        for surface, loops, step in zip(surfaces, sides, steps, strict=True)
    ]


def _sides_of(surface: BSplineSurface, loop: TrimLoop, creases: Sequence[Crease]) -> _Sides:
    starts, ends = loop.parameters, np.roll(loop.parameters, -1, axis=0)
    at = evaluate_surface(surface, *starts.T)
    crease, segment = np.full((2, len(at)), -1)
    forward = np.zeros(len(at), dtype=bool)
    for k in np.flatnonzero((loop.creases >= 0) & (loop.creases < len(creases))).tolist():
        number, onto = _nearest_segment(creases[loop.creases[k]].points, at[k], at[(k + 1) % len(at)])
        if number >= 0:
            crease[k], segment[k], forward[k] = loop.creases[k], number, onto
    return _Sides(starts, ends, crease, segment, forward)


def _nearest_segment(points: Array, start: Array, end: Array) -> tuple[int, bool]:
    """Which segment of a polyline (n, 3) lies between start and end, -1 for none; and whether it runs that way."""
    cost = np.stack(
        [
            np.maximum(np.linalg.norm(points[:-1] - a, axis=1), np.linalg.norm(points[1:] - b, axis=1))
            for a, b in ((start, end), (end, start))
        ]
    )
    way, number = np.unravel_index(int(np.argmin(cost)), cost.shape)
    return (int(number) if cost[way, number] < FARTHEST else -1), bool(way == 0)


def _between(
    surfaces: Sequence[BSplineSurface],
    creases: Sequence[Crease],
    steps: Sequence[Array],
    sides: Sequence[Sequence[_Sides]],
) -> dict[tuple[int, int], Array]:
    """Points (k, 3) between the ends of each segment of each crease.

    They lie on the surface that needs most of them; on one that needs fewer, the crease may leave its straight side.
    """
    used: dict[tuple[int, int], list[_Segment]] = defaultdict(list)
    for number, loops in enumerate(sides):
        for some in loops:
            for k in np.flatnonzero(some.crease >= 0).tolist():
                ends = (some.starts[k], some.ends[k])
                segment = _Segment(number, *(ends if some.forward[k] else ends[::-1]))
                used[int(some.crease[k]), int(some.segment[k])].append(segment)
    out = {}
    for key, segments in used.items():
        counts = [_count(s.last - s.first, steps[s.surface]) for s in segments]
        most = max(counts)
        at = np.arange(1, most)[:, None] / most
        deciding = [s for s, count in zip(segments, counts, strict=True) if count == most]
        placed = [evaluate_surface(surfaces[s.surface], *(s.first + at * (s.last - s.first)).T) for s in deciding]
        out[key] = np.mean(placed, axis=0)
    return out


def _count(way: Array, step: Array) -> int:
    """In how many sides a way (2,) in parameters is divided."""
    return max(1, int(np.ceil(np.max(np.abs(way) / step) - 1e-9)))


def _border(
    surface: BSplineSurface,
    sides: _Sides,
    step: Array,
    creases: Sequence[Crease],
    between: dict[tuple[int, int], Array],
) -> Border:
    parameters, points, shared = [], [], []
    for k, (start, end) in enumerate(zip(sides.starts, sides.ends, strict=True)):
        key = int(sides.crease[k]), int(sides.segment[k])
        count = len(between[key]) + 1 if key[0] >= 0 else _count(end - start, step)
        uv = start + np.arange(count)[:, None] / count * (end - start)
        placed = evaluate_surface(surface, *uv.T)
        on_crease = np.full(count, key[0] >= 0)
        if key[0] >= 0:
            ends = creases[key[0]].points[key[1] : key[1] + 2]
            line = np.concatenate([ends[:1], between[key], ends[1:]])
            placed = (line if sides.forward[k] else line[::-1])[:-1]
        elif sides.crease[k - 1] >= 0:
            # The last point of the crease before.
            before = creases[sides.crease[k - 1]].points[sides.segment[k - 1] + int(sides.forward[k - 1])]
            placed, on_crease = np.concatenate([before[None], placed[1:]]), np.arange(count) == 0
        parameters.append(uv)
        points.append(placed)
        shared.append(on_crease)
    return Border(np.concatenate(parameters), np.concatenate(points), np.concatenate(shared))
