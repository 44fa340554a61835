"""Faces, creases and corners as one: every crease a curve that both of its faces have, every corner one point.

Outlines of faces run along the curves in which the faces meet. Where one run ends and the next begins is a corner; what
both faces of a curve run along, between two corners or free ends, is a crease. The outlines are put together again
from the creases and from what is open. A crease that ends inside another one divides it, for edges meet in corners.
"""

from collections import Counter, defaultdict
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bsmap_cli.merge.curves import APART, Curve, FacePair, Shapes, between, locate, onto, place, touched, union
from bsmap_cli.merge.rings import Knots, Loop, Ring, knots_of_run, put_together
from bsmap_cli.merge.runs import OFF, Known, Run, find_meetings, find_runs
from bsmap_cli.merge.tracing import curves_of, unseen_curve
from bsmap_cli.model import Array, IntArray

SAME = 0.01
"""Metres between two corners, or two ends of runs, that are one."""
NOWHERE = np.zeros((0, 2))


class Edge(NamedTuple):
    """A crease of the map: its faces, its points (k, 3), the numbers of its corners or -1."""

    pair: FacePair
    points: Array
    corners: tuple[int, int]


class Topology(NamedTuple):
    """Rings of each face, edges between them, corners (k, 3)."""

    rings: dict[int, list[Ring]]
    edges: list[Edge]
    corners: Array


class _Corners(NamedTuple):
    """points (k, 3), and the faces of each."""

    points: Array
    faces: list[set[int]]

    def on(self, curve: Curve) -> tuple[IntArray, Array]:
        """Numbers (n,) of the corners on a curve, and their lengths (n,) along it."""
        mine = np.array([k for k, faces in enumerate(self.faces) if set(curve.pair) <= faces], dtype=np.int64)
        t, off = locate(curve, self.points[mine])
        return mine[off < OFF], t[off < OFF]


def find_topology(
    outlines: Mapping[int, Sequence[Array]], sides: Mapping[FacePair, Array], shapes: Shapes, gap: float
) -> Topology:
    """Edges and corners of the map, and the outlines that refer to them.

    Parameters
    ----------
    outlines : of each face its loops (k, 3), on its surface.
    sides : (k, 2, 3) segments of the creases of data sets, by the faces of the map that meet in them.
    gap : metres of open border between the end of a crease and a corner that are closed.
    """
    curves = curves_of({pair: ends for pair, ends in sides.items() if set(pair) <= outlines.keys()}, shapes)
    loops = _find_loops(outlines, curves, shapes, gap)
    if unseen := _unseen_curves(loops, curves, outlines, shapes, gap):
        curves += unseen
        loops = _find_loops(outlines, curves, shapes, gap)
    corners = _find_corners(loops, shapes, gap)
    _end_near_corners(loops, curves, corners, gap)
    knots = [_find_knots(number, curve, loops, corners, shapes) for number, curve in enumerate(curves)]
    edges, number_of = _find_edges(curves, knots, loops)
    edges, kept = _shared_corners(edges)
    rings: dict[int, list[Ring]] = {face: [] for face in outlines}
    for loop in loops:
        rings[loop.face].append(put_together(loop, curves, knots, number_of))
    return without_twice(Topology(rings, edges, corners.points[kept]))


def without_twice(whole: Topology) -> Topology:
    """The topology without edges along which one face runs twice: what lies on both sides of an edge ends at none."""
    count = Counter(
        (face, int(number))
        for face, rings in whole.rings.items()
        for ring in rings
        for number in ring.edges[ring.edges != np.roll(ring.edges, 1)]
    )
    twice = {number for (_, number), runs in count.items() if runs > 1 and number >= 0}
    if not twice:
        return whole
    kept = [number for number in range(len(whole.edges)) if number not in twice]
    new = np.full(len(whole.edges) + 1, -1)
    new[kept] = np.arange(len(kept))
    rings = {face: [ring._replace(edges=new[ring.edges]) for ring in some] for face, some in whole.rings.items()}
    return whole._replace(rings=rings, edges=[whole.edges[number] for number in kept])


def _find_loops(
    outlines: Mapping[int, Sequence[Array]], curves: Sequence[Curve], shapes: Shapes, gap: float
) -> list[Loop]:
    """All loops with their runs and where these meet."""
    of_face = {face: {k: curve for k, curve in enumerate(curves) if face in curve.pair} for face in sorted(outlines)}
    loops = [
        Loop(face, points, find_runs(points, mine, gap), [], np.full((0, 2), -1))
        for face, mine in of_face.items()
        for points in _not_slivers(outlines[face], mine.values())
    ]
    others = _others(loops, curves)
    loops = [loop._replace(runs=_runs_beside(loop, of_face[loop.face], others, gap)) for loop in loops]
    others = _others(loops, curves)
    out = []
    for face, points, runs, *_ in loops:
        mine = of_face[face]
        there = {k: others[face, k] for k in mine}
        runs = [r for r in runs if touched(there[r.curve], min(r.start, r.end), max(r.start, r.end), gap)]
        meetings = find_meetings(points, runs, mine, there, shapes, gap)
        out.append(Loop(face, points, runs, meetings, np.full((len(runs), 2), -1)))
    return out


def _others(loops: Sequence[Loop], curves: Sequence[Curve]) -> dict[tuple[int, int], Array]:
    """By face and curve the lengths (k, 2) along the curve between which the other face runs along it."""
    spans = defaultdict(list)
    for loop in loops:
        for run in loop.runs:
            spans[sum(curves[run.curve].pair) - loop.face, run.curve].append(sorted((run.start, run.end)))
    return defaultdict(lambda: NOWHERE, {key: union(np.array(some), APART) for key, some in spans.items()})


def _runs_beside(
    loop: Loop, mine: Mapping[int, Curve], others: Mapping[tuple[int, int], Array], gap: float
) -> list[Run]:
    """Runs of a loop, longer where the other face runs along the curve, too."""
    longest = sorted(loop.runs, key=lambda run: abs(run.end - run.start))
    known = {run.curve: Known(run.sign, others[loop.face, run.curve]) for run in longest}
    return find_runs(loop.points, mine, gap, known) if known else loop.runs


def _not_slivers(loops: Sequence[Array], curves: Collection[Curve]) -> Sequence[Array]:
    """The loops of a face but those that are remnants along curves; all where there is nothing else."""
    return [points for points in loops if not _is_sliver(points, curves)] or loops


def _is_sliver(loop: Array, curves: Iterable[Curve]) -> bool:
    """Whether a narrow loop lies along a single curve as a whole: of two data sets' outlines there, a remnant."""
    following = np.roll(loop, -1, axis=0)
    area = np.linalg.norm(np.cross(loop - loop[0], following - loop[0]).sum(axis=0)) / 2.0
    length = np.linalg.norm(following - loop, axis=1).sum()
    return any(area < length * curve.beside / 2.0 and locate(curve, loop)[1].max() < curve.beside for curve in curves)


def _unseen_curves(
    loops: Sequence[Loop],
    curves: Sequence[Curve],
    outlines: Mapping[int, Sequence[Array]],
    shapes: Shapes,
    gap: float,
) -> list[Curve]:
    """Curves of faces that meet in corners, but have none yet."""
    known = {curve.pair for curve in curves}
    at: dict[FacePair, list[Array]] = defaultdict(list)
    for meeting in (meeting for loop in loops for meeting in loop.meetings):
        for pair in combinations(meeting.faces, 2):
            if pair not in known:
                at[pair].append(meeting.point)
    found = (unseen_curve(pair, np.array(at[pair]), outlines, shapes, gap) for pair in sorted(at))
    return [curve for curve in found if curve is not None]


def _find_corners(loops: Sequence[Loop], shapes: Shapes, gap: float) -> _Corners:
    """Corners of all meetings, those nearby being one; the runs' ends get their numbers."""
    meetings = [(loop, meeting) for loop in loops for meeting in loop.meetings]
    points = np.array([meeting.point for _, meeting in meetings]).reshape(-1, 3)
    near = cKDTree(points).query_pairs(gap, output_type="ndarray") if len(points) else np.zeros((0, 2), dtype=int)
    # The same three faces meet once; where they touch without an angle, each loop tells another place.
    alike = np.array([meetings[a][1].faces == meetings[b][1].faces for a, b in near.tolist()], dtype=bool)
    near = near[alike | (np.linalg.norm(points[near[:, 0]] - points[near[:, 1]], axis=1) < SAME)]
    n = len(points)
    label = connected_components(coo_array((np.ones(len(near)), near.T), shape=(n, n)), directed=False)[1]
    faces: list[set[int]] = [set() for _ in range(label.max(initial=-1) + 1)]
    for (loop, meeting), corner in zip(meetings, label.tolist(), strict=True):
        faces[corner] |= set(meeting.faces)
        loop.corners[meeting.run, 1] = loop.corners[meeting.following, 0] = corner
    placed = [
        onto([shapes[face] for face in sorted(some)], points[label == corner].mean(axis=0)[None])[0]
        for corner, some in enumerate(faces)
    ]
    return _Corners(np.array(placed).reshape(-1, 3), faces)


def _end_near_corners(loops: Sequence[Loop], curves: Sequence[Curve], corners: _Corners, gap: float) -> None:
    """Ends of runs that miss a corner of their curve by little get its number, if the other end has not."""
    on = [corners.on(curve) for curve in curves]
    for loop in loops:
        for k, run in enumerate(loop.runs):
            numbers, t = on[run.curve]
            for side, end in enumerate((run.start, run.end)):
                away = np.where(numbers == loop.corners[k, 1 - side], np.inf, np.abs(t - end))
                if loop.corners[k, side] < 0 and away.min(initial=np.inf) < gap:
                    loop.corners[k, side] = numbers[np.argmin(away)]


def _find_knots(number: int, curve: Curve, loops: Sequence[Loop], corners: _Corners, shapes: Shapes) -> Knots:
    """Of one curve: corners in which runs end, or that lie on it, and free ends, those nearby being one."""
    ends = [
        (t, int(loop.corners[k, side]))
        for loop in loops
        for k, run in enumerate(loop.runs)
        if run.curve == number
        for side, t in enumerate((run.start, run.end))
    ]
    numbers = sorted({corner for _, corner in ends if corner >= 0} | set(corners.on(curve)[0].tolist()))
    points = corners.points[numbers]
    t = locate(curve, points)[0] if numbers else np.zeros(0)
    free = np.sort([end for end, corner in ends if corner < 0])
    free = free[np.all(np.abs(free[:, None] - t) > SAME, axis=1)]
    parts = np.split(free, np.flatnonzero(np.diff(free) > SAME) + 1) if len(free) else []
    means = np.array([part.mean() for part in parts])
    order = np.argsort(np.concatenate([t, means]), kind="stable")
    return Knots(
        np.concatenate([t, means])[order],
        np.concatenate([np.array(numbers, dtype=np.int64), np.full(len(means), -1)])[order],
        np.concatenate([points, place(curve, means, shapes) if len(means) else np.zeros((0, 3))])[order],
    )


def _find_edges(
    curves: Sequence[Curve], knots: Sequence[Knots], loops: Sequence[Loop]
) -> tuple[list[Edge], dict[tuple[int, int], int]]:
    """What both faces of a curve run along, from knot to knot; and its number by curve and first knot."""
    had: list[list[set[int]]] = [[set() for _ in own.t] for own in knots]
    for loop in loops:
        for k, run in enumerate(loop.runs):
            start, end = knots_of_run(loop, k, knots[run.curve])
            for knot in range(min(start, end), max(start, end)):
                had[run.curve][knot].add(loop.face)
    edges: list[Edge] = []
    number_of = {}
    for number, (curve, own) in enumerate(zip(curves, knots, strict=True)):
        for knot, faces in enumerate(had[number]):
            if faces == set(curve.pair):
                number_of[number, knot] = len(edges)
                inner = between(curve, own.t[knot], own.t[knot + 1])
                points = np.concatenate([own.points[knot : knot + 1], inner, own.points[knot + 1 : knot + 2]])
                edges.append(Edge(curve.pair, points, (int(own.corners[knot]), int(own.corners[knot + 1]))))
    return edges, number_of


def _shared_corners(edges: Sequence[Edge]) -> tuple[list[Edge], IntArray]:
    """The edges, their corners numbered anew: only those in which several end stay, whose old numbers come, too."""
    ends = np.array([edge.corners for edge in edges], dtype=np.int64).reshape(-1, 2)
    numbers, count = np.unique(ends[ends >= 0], return_counts=True)
    kept = numbers[count > 1]
    new = {int(corner): number for number, corner in enumerate(kept)} | {-1: -1}
    return [
        edge._replace(corners=(new.get(a, -1), new.get(b, -1)))
        for edge, (a, b) in zip(edges, ends.tolist(), strict=True)
    ], kept
