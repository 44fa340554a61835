"""Outlines of faces: the union of the cells between neighbouring beams and scans that hit a face, cut at creases.

As in marching squares: a cell whose corners belong to different faces is shared out at the crossings on its sides.
Where two faces do not meet, each ends at its last beam.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.polygons import signed_area
from bsmap_cli.fit.crossings import Crossings
from bsmap_cli.model import Array, IntArray

SIDES = (((0, 0), "along"), ((0, 1), "across"), ((1, 0), "along"), ((0, 0), "across"))
"""First beam of each side of a cell, going round from corner (0, 0) to (0, 1), (1, 1), (1, 0), and its kind."""
CORNERS = ((0, 0), (0, 1), (1, 1), (1, 0))


class Loops(NamedTuple):
    """Closed loops of a face, each a list of vertices: beams (row * n + column), or m * n + number of a crossing."""

    vertices: list[list[int]]


def outline(
    face: int, labels: IntArray, crossings: Crossings, uv: Array, crossing_uv: Array, believed: NDArray[np.bool_]
) -> Loops:
    """Loops around the cells of a face, counter-clockwise in its parameters, holes clockwise.

    Where the cells lie mirrored in the parameters (beyond the pole of a rotation), they get loops of their own, so
    that every cell is run around counter-clockwise: a point is on the face if the loops wind around it.

    uv : (m, n, 2) parameters of the face's beams.  crossing_uv : (k, 2) of all crossings on this face.
    believed : (4, m - 1, n - 1) corners of cells that count, in the order of CORNERS.
    """
    member = labels == face
    corners = np.stack([member[:-1, :-1], member[:-1, 1:], member[1:, 1:], member[1:, :-1]]) & believed
    full = np.all(corners, axis=0)
    row, column = np.nonzero(np.any(corners, axis=0) & ~full)
    mirrored = np.zeros_like(full)
    cells = np.nonzero(full)
    mirrored[cells] = signed_area(np.stack([uv[cells[0] + i, cells[1] + k] for i, k in CORNERS], axis=1)) < 0.0
    shares = _shares(crossings, corners[:, row, column].T, row, column, face)
    at = np.concatenate([uv.reshape(-1, 2), crossing_uv])[shares.vertices]
    backwards = _areas(shares, at) < 0.0
    loops: list[list[int]] = []
    for turned in (False, True):
        edges = np.concatenate([_border(full & (mirrored == turned)), _edges(shares, backwards == turned)])
        loops += [loop[::-1] if turned else loop for loop in chain(_left_over(edges))]
    return Loops(loops)


class _Shares(NamedTuple):
    """Polygons of a face's shares of cells: all vertices (k,), polygon after polygon; where each begins (p,)."""

    vertices: IntArray
    first: IntArray

    @property
    def following(self) -> IntArray:
        """(k,) vertex after each in its polygon."""
        out = np.roll(self.vertices, -1)
        out[np.append(self.first, len(out))[1:] - 1] = self.vertices[self.first]
        return out

    @property
    def of(self) -> IntArray:
        """(k,) number of the polygon of each vertex."""
        return np.repeat(np.arange(len(self.first)), np.diff(np.append(self.first, len(self.vertices))))


def _shares(crossings: Crossings, own: NDArray[np.bool_], row: IntArray, column: IntArray, face: int) -> _Shares:
    """A face's shares of cells (k,): own corners (k, 4) and the crossings on sides to others, where these are 3."""
    m, n = crossings.along.shape
    border = own != np.roll(own, -1, axis=1)
    table = np.full((len(row), 8), -1)
    for side, ((i, k), kind) in enumerate(SIDES):
        corner = (row + CORNERS[side][0]) * n + column + CORNERS[side][1]
        table[:, 2 * side] = np.where(own[:, side], corner, -1)
        number = (crossings.along if kind == "along" else crossings.across)[row + i, column + k]
        there = border[:, side] & (number >= 0)
        there[there] = crossings.reached(face, number[there])
        table[:, 2 * side + 1] = np.where(there, m * n + number, -1)
    table = table[np.count_nonzero(table >= 0, axis=1) >= 3]
    count = np.count_nonzero(table >= 0, axis=1)
    return _Shares(table[table >= 0], np.cumsum(count) - count)


def _areas(shares: _Shares, at: Array) -> Array:
    """Signed areas (p,) of polygons whose vertices lie at (k, 2)."""
    if not len(shares.first):
        return np.zeros(0)
    of = shares.of
    x, y = (at - at[shares.first][of]).T
    behind = np.arange(1, len(of) + 1)
    behind[np.append(shares.first, len(of))[1:] - 1] = shares.first
    return np.asarray(0.5 * np.add.reduceat(x * y[behind] - x[behind] * y, shares.first))


def _edges(shares: _Shares, keep: NDArray[np.bool_]) -> IntArray:
    """(k, 2) directed edges of the polygons to keep (p,)."""
    return np.column_stack([shares.vertices, shares.following])[keep[shares.of]]


def _border(full: NDArray[np.bool_]) -> IntArray:
    """(k, 2) those directed sides of whole cells that no other whole cell shares."""
    n = full.shape[1] + 1
    padded = np.pad(full, 1)
    shifts = (padded[:-2, 1:-1], padded[1:-1, 2:], padded[2:, 1:-1], padded[1:-1, :-2])
    out = []
    for side, neighbour in enumerate(shifts):
        row, column = np.nonzero(full & ~neighbour)
        ends = [(row + i) * n + column + k for i, k in (CORNERS[side], CORNERS[(side + 1) % 4])]
        out.append(np.column_stack(ends))
    return np.concatenate(out)


def _left_over(edges: IntArray) -> IntArray:
    """(j, 2) of directed edges (k, 2), those that no edge the other way cancels."""
    size = int(edges.max(initial=0)) + 1
    there, count = np.unique(edges[:, 0] * size + edges[:, 1], return_counts=True)
    back = there % size * size + there // size
    at = np.minimum(np.searchsorted(there, back), len(there) - 1)
    left = np.repeat(there, np.maximum(count - np.where(there[at] == back, count[at], 0), 0))
    return np.column_stack([left // size, left % size])


def chain(edges: IntArray) -> list[list[int]]:
    """Closed loops of directed edges (k, 2)."""
    following: dict[int, list[int]] = defaultdict(list)
    for a, b in edges[np.lexsort(edges.T[::-1])].tolist():
        following[a].append(b)
    loops = []
    for start in sorted(following):
        while following[start]:
            loop, at = [start], following[start].pop()
            while at != start:
                loop.append(at)
                at = following[at].pop()
            loops.append(loop)
    return loops
