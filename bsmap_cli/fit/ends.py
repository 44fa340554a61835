"""Where a face ends along each scan, and what follows from it for the ground between two scans.

Scans of a rotation lie 40 cm and more apart a few metres away, and a corner may stand between two of them. What the
scans themselves tell is where each face ends: at a face that it meets, or, where it meets none, at its last beam. Two
things follow. A crossing between two scans lies no farther than the ends of both faces: three faces meet in a point.
And the cells between two scans do not reach through a face in which one of the scans shows them to end.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.crossings import EXACT, FARTHEST, SETTLED, Crossings
from bsmap_cli.fit.feet import Feet, Table, offsets
from bsmap_cli.fit.labels import places_of_faces, runs_of
from bsmap_cli.model import Array, IntArray

BEYOND = 0.002
"""Metres by which a crossing lies beyond an end before it is moved back."""
THROUGH = 0.005
"""Metres by which a beam's foot lies beyond an end before the cells to it are doubted."""
STEPS = 8
FLATTEST = 0.1
"""Least determinant of three unit normals that meet in a point."""


class Ends(NamedTuple):
    """Ends of the run of each beam, (2, m, n): towards lower beams, towards higher ones.

    face : number of the face that it meets there, -1 where it ends openly.
    last : its last beam with a return, -1 outside of runs.  inner : a beam well inside the run.
    """

    face: IntArray
    last: IntArray
    inner: IntArray


def find_ends(grid: BeamGrid, labels: IntArray, crossings: Crossings) -> Ends:
    """Ends of the runs of faces along the scans."""
    m, n = labels.shape
    row, start, stop, _ = runs_of(labels)
    # Numbers of the returns of each run, those without any left out.
    first, behind = (grid.before.number[row * n + end] for end in (start, stop))
    row, start, stop, first, behind = (of[behind > first] for of in (row, start, stop, first, behind))
    # A crossing on the edge before the run, or behind it.
    into, out = np.full((2, len(row)), -1)
    k = np.flatnonzero((start > 0) & (crossings.along[row, start - 1] >= 0))
    into[k] = labels[row[k], start[k] - 1]
    k = np.flatnonzero((stop < n) & (crossings.along[row, stop - 1] >= 0))
    out[k] = labels[row[k], stop[k]]
    place = grid.before.place % n
    middle = place[first + (behind - first) // 2]
    of_runs = np.stack([into, out, place[first], place[behind - 1], middle, middle])
    # Runs and what lies between them, in turns.
    values = np.full((6, 2 * len(row) + 1), -1)
    values[:, 1::2] = of_runs
    bounds = np.column_stack([row * n + start, row * n + stop]).ravel()
    return Ends(*np.repeat(values, np.diff(bounds, prepend=0, append=m * n), axis=1).reshape(3, 2, m, n))


def on_faces(grid: BeamGrid, labels: IntArray, feet: Sequence[Feet]) -> BeamGrid:
    """The grid, its points moved along their beams to their feet on their faces: without the noise."""
    points = grid.points.copy()
    for at, of_face in zip(places_of_faces(grid, labels, len(feet)), feet, strict=True):
        points.reshape(-1, 3)[at] = of_face.points
    return replace(grid, points=points)


def within_ends(grid: BeamGrid, labels: IntArray, table: Table, crossings: Crossings, ends: Ends) -> Crossings:
    """Crossings between scans, those beyond an end of one of their faces moved back to it along the crease.

    Where the crease does not reach the end nearby, there is no crossing. The grid's points lie on their faces.
    """
    row, column = np.nonzero(crossings.across >= 0)
    number = crossings.across[row, column]
    points, gone = crossings.points.copy(), np.zeros(len(crossings.points), dtype=bool)
    reach = FARTHEST * np.linalg.norm(grid.points[row, column] - grid.points[row + 1, column], axis=1)
    for next_scan in (0, 1):
        for side in (0, 1):
            end = _End(grid, table, ends, side, row + next_scan, column)
            wrong = np.flatnonzero(end.beyond(points[number]) > BEYOND)
            moved, settled = _meet_end(table, crossings.faces[number[wrong]], points[number[wrong]], end, wrong)
            settled &= np.linalg.norm(moved - crossings.points[number[wrong]], axis=1) < reach[wrong]
            points[number[wrong[settled]]] = moved[settled]
            gone[number[wrong[~settled]]] = True
    across = crossings.across.copy()
    across[row[gone[number]], column[gone[number]]] = -1
    return crossings._replace(across=across, points=points)


def passed_through(grid: BeamGrid, labels: IntArray, table: Table, crossings: Crossings, ends: Ends) -> Crossings:
    """Crossings between scans, marked where the scan that hits one face passes through the other.

    A wall ends between two scans; the one beyond its end sees the floor go on behind the wall's place: there the wall
    does not reach the crossing, which lies on a crease that ends before it.
    """
    row, column = np.nonzero(crossings.across >= 0)
    number = crossings.across[row, column]
    passed = crossings.passed.copy()
    for side in (0, 1):
        other = row + 1 - side
        start, stop = ends.last[0, other, column], ends.last[1, other, column]
        face = crossings.faces[number, side]
        of = np.flatnonzero(start >= 0)
        first, last = (offsets(table, face[of], grid.points[other[of], end[of]])[0] for end in (start, stop))
        passed[number[of], side] = (np.minimum(first, last) < -THROUGH) & (np.maximum(first, last) > THROUGH)
    return crossings._replace(passed=passed)


class _End:
    """One end of the runs of k beams: the face met there, or the plane across the scan line at the last beam."""

    def __init__(
        self, grid: BeamGrid, table: Table, ends: Ends, side: int | IntArray, row: IntArray, column: IntArray
    ) -> None:
        self.table, self.face = table, ends.face[side, row, column]
        last, inner = ends.last[side, row, column], ends.inner[side, row, column]
        self.place = grid.points[row, last]
        within = grid.points[row, inner]
        way = self.place - within
        length = np.linalg.norm(way, axis=1, keepdims=True)
        self.known = (last >= 0) & ((self.face >= 0) | (length[:, 0] > 0.0))
        self.way = way / np.maximum(length, 1e-12)
        value = self.values(within, np.arange(len(row)))[0]
        self.sign = np.where(self.face >= 0, -np.sign(value), 1.0)

    def beyond(self, points: Array) -> Array:
        """(k,) metres by which points (k, 3) lie beyond the end; -inf where it is not known."""
        value = self.sign * self.values(points, np.arange(len(points)))[0]
        return np.asarray(np.where(self.known, value, -np.inf))

    def values(self, points: Array, at: IntArray) -> tuple[Array, Array]:
        """(j,) distances of points (j, 3) to the ends `at` (j,), of either sign, and (j, 3) unit normals."""
        normals = self.way[at].copy()
        values = np.sum((points - self.place[at]) * normals, axis=1)
        of = np.flatnonzero(self.face[at] >= 0)
        values[of], normals[of] = offsets(self.table, self.face[at[of]], points[of])
        return values, normals


def _meet_end(table: Table, pair: IntArray, points: Array, end: _End, at: IntArray) -> tuple[Array, NDArray[np.bool_]]:
    """Points (j, 3) moved onto two faces `pair` (j, 2) and the ends `at`, by Newton's method; and which got there."""
    good = np.ones(len(points), dtype=bool)
    for _ in range(STEPS):
        values, normals = _three(table, pair, points, end, at)
        good &= np.abs(np.linalg.det(normals)) > FLATTEST
        normals[~good] = np.eye(3)
        step = np.where(good[:, None], np.linalg.solve(normals, values[:, :, None])[:, :, 0], 0.0)
        points = points - step
        if np.abs(step).max(initial=0.0) < EXACT:
            break
    return points, good & (np.abs(_three(table, pair, points, end, at)[0]).max(axis=1, initial=0.0) < SETTLED)


def _three(table: Table, pair: IntArray, points: Array, end: _End, at: IntArray) -> tuple[Array, Array]:
    """(j, 3) distances to two faces and an end, (j, 3, 3) normals."""
    values, normals = np.empty((len(points), 3)), np.empty((len(points), 3, 3))
    for side in (0, 1):
        values[:, side], normals[:, side] = offsets(table, pair[:, side], points)
    values[:, 2], normals[:, 2] = end.values(points, at)
    return values, normals


def doubtful_cells(
    grid: BeamGrid, labels: IntArray, table: Table, crossings: Crossings, ends: Ends
) -> NDArray[np.bool_]:
    """(m - 1, n - 1) cells that reach through a face in which one of their two scans shows their face to end.

    A scan that passes a corner sees the face go on, its neighbour sees it end: somewhere between is the corner. Where
    the corner's other face is seen, too, both tell where it stands, and only the cells that hold it are doubtful. The
    grid's points lie on their faces: with their noise they would seem to lie beyond.
    """
    bad = _behind(grid, labels, table, ends)
    straight, rising, falling = _through(grid, labels, table, crossings, ends)
    return np.asarray((bad | straight)[:, :-1] | (bad | straight)[:, 1:] | rising[:, :-1] | falling[:, 1:])


def _through(grid: BeamGrid, labels: IntArray, table: Table, crossings: Crossings, ends: Ends) -> NDArray[np.bool_]:
    """(3, m - 1, n) whether a beam and one of the next scan hit one face, with an end in between.

    The beam of the next scan is the same one, that behind it or, last, that before it. The end is that of one of both
    runs: the other beam lies beyond it.
    """
    (m, n), steps = labels.shape, (0, 1, -1)
    bad = np.zeros((len(steps), m - 1, n), dtype=bool)
    met = _corners(labels, crossings)
    found = []
    for number, step in enumerate(steps):
        own, other = slice(max(0, -step), n - max(0, step)), slice(max(0, step), n - max(0, -step))
        same = (labels[:-1, own] == labels[1:, other]) & (labels[:-1, own] >= 0)
        same &= grid.hit[:-1, own] & grid.hit[1:, other]
        for k in (0, 1):
            # Two runs that end at the same face say nothing of what is between them, nor do two that end openly.
            r, c = np.nonzero(same & (ends.face[k, :-1, own] != ends.face[k, 1:, other]))
            found.append((np.full(len(r), number), np.full(len(r), k), r, c + own.start))
    which, side, r, c = (np.concatenate(of) for of in zip(*found, strict=True))
    following = c + np.array(steps)[which]
    first, second = _End(grid, table, ends, side, r, c), _End(grid, table, ends, side, r + 1, following)
    here, there = grid.points[r, c], grid.points[r + 1, following]
    a0, a1, b0, b1 = first.beyond(here), first.beyond(there), second.beyond(here), second.beyond(there)
    corner = met[r, first.face, second.face]
    wrong = ((first.face >= 0) & (a1 > THROUGH)) | ((second.face >= 0) & (b0 > THROUGH))
    # The way from one beam to the other leaves the first's side before it comes to the second's.
    leaves = (a1 > THROUGH) & (b0 > THROUGH) & (_zero(a0, a1) < _zero(b0, b1))
    wrong = np.where(corner, leaves, wrong)
    bad[which[wrong], r[wrong], c[wrong]] = True
    return bad


def _zero(start: Array, end: Array) -> Array:
    """Share of the way at which a value that goes evenly from start to end is 0."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(start / (start - end))


def _corners(labels: IntArray, crossings: Crossings) -> NDArray[np.bool_]:
    """(m - 1, f + 1, f + 1) whether two faces, one in this scan and one in the next, meet between them."""
    count = int(labels.max(initial=-1)) + 2
    out = np.zeros((labels.shape[0] - 1, count, count), dtype=bool)
    row, column = np.nonzero(crossings.across >= 0)
    out[row, labels[row, column], labels[row + 1, column]] = True
    return out


def _behind(grid: BeamGrid, labels: IntArray, table: Table, ends: Ends) -> NDArray[np.bool_]:
    """(m - 1, n) whether one beam hits a face, the other one a face that ends it, and the first lies beyond that.

    The run of the one face shows, at its end, on which side of it the other one lies in that scan.
    """
    bad = np.zeros((labels.shape[0] - 1, labels.shape[1]), dtype=bool)
    two = (labels[:-1] != labels[1:]) & (labels[:-1] >= 0) & (labels[1:] >= 0)
    row, column = np.nonzero(two & grid.hit[:-1] & grid.hit[1:])
    for here, there in ((0, 1), (1, 0)):
        face, ender = labels[row + here, column], labels[row + there, column]
        for side, step in ((0, -1), (1, 1)):
            follows = ends.face[side, row + there, column] == face
            r, c = row[follows], column[follows]
            neighbour = _first_beyond(labels, ends, side, r + there, c, step)
            end = _End(grid, table, ends, 1 - side, r + there, neighbour)
            wrong = (end.face == ender[follows]) & (end.beyond(grid.points[r + here, c]) > THROUGH)
            bad[r[wrong], c[wrong]] = True
    return bad


def _first_beyond(labels: IntArray, ends: Ends, side: int, row: IntArray, column: IntArray, step: int) -> IntArray:
    """First beam behind the end of the run of each beam."""
    return np.asarray(np.clip(ends.last[side, row, column] + step, 0, labels.shape[1] - 1))
