"""Outlines put together from the edges along their runs and from what is open."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.merge.curves import Curve, between, locate
from bsmap_cli.merge.regions import GRID
from bsmap_cli.merge.runs import Meeting, Run, open_part
from bsmap_cli.model import Array, IntArray


class Ring(NamedTuple):
    """Loop of a face: points (k, 3) on it, and the number of the edge (k,) from each to the next one, or -1.

    rims : (k,) of each side, as in TrimLoop.
    """

    points: Array
    edges: IntArray
    rims: Array | None = None

    def of(self, kept: NDArray[np.bool_]) -> "Ring":
        """The ring of those vertices (k,) that are kept; the sides from them follow what they did."""
        return Ring(self.points[kept], self.edges[kept], None if self.rims is None else self.rims[kept])


class Loop(NamedTuple):
    """A loop of a face: its points (k, 3), its runs, where they meet, and the corners (r, 2) of their ends or -1."""

    face: int
    points: Array
    runs: list[Run]
    meetings: list[Meeting]
    corners: IntArray


class Knots(NamedTuple):
    """Places at which a curve is divided: ascending lengths t (k,), corners (k,) or -1, points (k, 3)."""

    t: Array
    corners: IntArray
    points: Array

    def at(self, t: float, corner: int) -> int:
        """The knot of the end of a run."""
        return int(np.flatnonzero(self.corners == corner)[0] if corner >= 0 else np.argmin(np.abs(self.t - t)))


def knots_of_run(loop: Loop, k: int, knots: Knots) -> tuple[int, int]:
    """The knots at which the k-th run of a loop starts and ends; the same twice where nothing of it is left."""
    run = loop.runs[k]
    start, end = (knots.at(t, int(c)) for t, c in zip((run.start, run.end), loop.corners[k], strict=True))
    return (start, end) if (end - start) * run.sign > 0 else (start, start)


def put_together(
    loop: Loop,
    curves: Sequence[Curve],
    knots: Sequence[Knots],
    number_of: Mapping[tuple[int, int], int],
) -> Ring:
    """The loop put together from edges and from what is open; as it was where hardly anything of it would be left.

    number_of : of each edge, by its curve and the first of its knots.
    """
    ring = _put_together(loop, curves, knots, number_of) if loop.runs else None
    return ring if ring and len(ring.points) > 2 else Ring(loop.points, np.full(len(loop.points), -1))


def _put_together(
    loop: Loop, curves: Sequence[Curve], knots: Sequence[Knots], number_of: Mapping[tuple[int, int], int]
) -> Ring:
    met = {meeting.run for meeting in loop.meetings}
    points, numbers = [np.zeros((0, 3))], list[int]()
    for k, run in enumerate(loop.runs):
        own = knots[run.curve]
        start, end = knots_of_run(loop, k, own)
        for knot in range(start, end, run.sign):
            low, high = sorted((knot, knot + run.sign))
            edge = number_of.get((run.curve, low), -1)
            inner = between(curves[run.curve], own.t[low], own.t[high])
            line = np.concatenate([own.points[low : low + 1], inner, own.points[high : high + 1]])
            points.append(line[:: run.sign][:-1])
            numbers += [edge] * (len(line) - 1)
        if k not in met:
            way = _open_way(loop, k, curves, knots)
            points.append(np.concatenate([own.points[end : end + 1], way]))
            numbers += [-1] * (len(way) + 1)
    return _without_doubles(np.concatenate(points), np.array(numbers, dtype=np.int64))


def _open_way(loop: Loop, k: int, curves: Sequence[Curve], knots: Sequence[Knots]) -> Array:
    """Vertices (n, 3) of a loop between its k-th run and the next one."""
    one, following = loop.runs[k], (k + 1) % len(loop.runs)
    other = loop.runs[following]
    way = open_part(loop.points, one.last, other.first)[1:-1]
    end, start = knots_of_run(loop, k, knots[one.curve])[1], knots_of_run(loop, following, knots[other.curve])[0]
    way = _off_run(way, curves[one.curve], one.end, knots[one.curve].t[end], one.sign)
    back = _off_run(way[::-1], curves[other.curve], other.start, knots[other.curve].t[start], -other.sign)
    return back[::-1]


def _without_doubles(points: Array, edges: IntArray) -> Ring:
    """The ring, of points at the same place only the last one."""
    away = np.any(np.roll(points, -1, axis=0) != points, axis=1) | (edges >= 0)
    return Ring(points[away], edges[away])


def _off_run(way: Array, curve: Curve, was: float, end: float, sign: int) -> Array:
    """The way (k, 3) on from the end of a run, without what of its beginning lies beside that by which the run became
    longer. What doubles back farther is the other side of a narrow strip.

    was : length along the curve at which the run ended.
    """
    if not len(way):
        return way
    t, off = locate(curve, way)
    on = (off < curve.beside) & ((t - end) * sign <= 0.0) & ((t - was) * sign > GRID)
    return way[len(way) if on.all() else int(np.argmin(on)) :]
