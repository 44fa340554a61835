"""Outlines of faces: the union of the cells between neighbouring beams and scans that hit a face, cut at creases.

As in marching squares: a cell whose corners belong to different faces is shared out at the crossings on its sides.
Where two faces do not meet, each ends at its last beam.
"""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.crossings import Crossings
from bsmap_cli.model import Array, IntArray

SIDES = (((0, 0), "along"), ((0, 1), "across"), ((1, 0), "along"), ((0, 0), "across"))
"""First beam of each side of a cell, going round from corner (0, 0) to (0, 1), (1, 1), (1, 0), and its kind."""
CORNERS = ((0, 0), (0, 1), (1, 1), (1, 0))


class Nodes(NamedTuple):
    """Parameters on their faces of what outlines run through.

    beams : (m, n, 2) of beams.  crossings : (k, 2, 2) of crossings, on both of their faces (k, 2).
    """

    beams: Array
    crossings: Array
    faces: IntArray

    def at(self, face: int, vertices: IntArray) -> Array:
        """(j, 2) on a face, of vertices (j,): beams (row * n + column), or m * n + number of a crossing."""
        first = self.beams.shape[0] * self.beams.shape[1]
        out = np.empty((len(vertices), 2))
        crossing = vertices >= first
        number = vertices[crossing] - first
        out[~crossing] = self.beams.reshape(-1, 2)[vertices[~crossing]]
        out[crossing] = self.crossings[number, (self.faces[number, 1] == face).astype(np.int64)]
        return out


def outlines(
    faces: int, labels: IntArray, crossings: Crossings, nodes: Nodes, believed: NDArray[np.bool_]
) -> list[list[list[int]]]:
    """Loops around the cells of each of so many faces, counter-clockwise in its parameters, holes clockwise.

    Where the cells lie mirrored in the parameters (beyond the pole of a rotation), they get loops of their own, so
    that every cell is run around counter-clockwise: a point is on the face if the loops wind around it.

    believed : (4, m - 1, n - 1) corners of cells that count, in the order of CORNERS.
    """
    corners = np.stack([labels[:-1, :-1], labels[:-1, 1:], labels[1:, 1:], labels[1:, :-1]])
    corners[~believed] = -1
    same = (corners[0] == corners[1]) & (corners[0] == corners[2]) & (corners[0] == corners[3])
    group = np.where(same & (corners[0] >= 0), 2 * corners[0] + _mirrored(nodes.beams), -1)
    row, column = np.nonzero(~same)
    corners = corners[:, row, column].T
    sides, of_side = _borders(group)
    loops: list[list[list[int]]] = []
    for face in range(faces):
        own = corners == face
        shared = np.flatnonzero(own.any(axis=1))
        shares = _shares(crossings, own[shared], row[shared], column[shared], face)
        backwards = _areas(shares, nodes.at(face, shares.vertices)) < 0.0
        loops.append([])
        for turned in (False, True):
            edges = np.concatenate([sides[of_side == 2 * face + turned], _edges(shares, backwards == turned)])
            loops[-1] += [loop[::-1] if turned else loop for loop in chain(_left_over(edges))]
    return loops


def _mirrored(uv: Array) -> NDArray[np.bool_]:
    """(m - 1, n - 1) cells that are run around clockwise at parameters (m, n, 2)."""
    down, up = uv[1:, 1:] - uv[:-1, :-1], uv[1:, :-1] - uv[:-1, 1:]
    return np.asarray(down[..., 0] * up[..., 1] < down[..., 1] * up[..., 0])


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


def _borders(group: IntArray) -> tuple[IntArray, IntArray]:
    """(k, 2) those directed sides of cells in groups (m - 1, n - 1) that no cell of the same group shares; and their
    groups (k,).
    """
    n = group.shape[1] + 1
    padded = np.pad(group, 1, constant_values=-1)
    shifts = (padded[:-2, 1:-1], padded[1:-1, 2:], padded[2:, 1:-1], padded[1:-1, :-2])
    out, of = [], []
    for side, neighbour in enumerate(shifts):
        row, column = np.nonzero((group >= 0) & (group != neighbour))
        ends = [(row + i) * n + column + k for i, k in (CORNERS[side], CORNERS[(side + 1) % 4])]
        out.append(np.column_stack(ends))
        of.append(group[row, column])
    return np.concatenate(out), np.concatenate(of)


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
