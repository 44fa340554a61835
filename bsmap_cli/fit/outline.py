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
    believed : (m - 1, n - 1) cells that count.
    """
    m, n = labels.shape
    member = labels == face
    corners = np.stack([member[:-1, :-1], member[:-1, 1:], member[1:, 1:], member[1:, :-1]])
    full = np.all(corners, axis=0) & believed
    mixed = np.any(corners, axis=0) & ~full & believed
    quads = np.stack([uv[:-1, :-1], uv[:-1, 1:], uv[1:, 1:], uv[1:, :-1]], axis=2)
    area = np.where(full, signed_area(quads), 0.0)
    edges: tuple[dict[tuple[int, int], int], dict[tuple[int, int], int]] = (defaultdict(int), defaultdict(int))
    for mirrored in (False, True):
        _add_full(edges[mirrored], full & (area < 0.0 if mirrored else area >= 0.0), n)
    for row, column in np.argwhere(mixed).tolist():
        polygon = _share(face, labels, crossings, row, column)
        if len(polygon) < 3:
            continue
        at = np.array([crossing_uv[v - m * n] if v >= m * n else uv[v // n, v % n] for v in polygon])
        mirrored = bool(signed_area(at) < 0.0)
        for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            _add(edges[mirrored], a, b)
    loops = chain(edges[False])
    loops += [loop[::-1] for loop in chain(edges[True])]
    return Loops(loops)


def _add(edges: dict[tuple[int, int], int], a: int, b: int) -> None:
    """Add a directed edge; it cancels one that goes the other way."""
    if edges.get((b, a), 0) > 0:
        edges[(b, a)] -= 1
    else:
        edges[(a, b)] += 1


def _add_full(edges: dict[tuple[int, int], int], full: NDArray[np.bool_], n: int) -> None:
    """Add those sides of whole cells that no other whole cell shares."""
    padded = np.pad(full, 1)
    shifts = (padded[:-2, 1:-1], padded[1:-1, 2:], padded[2:, 1:-1], padded[1:-1, :-2])
    for side, neighbour in enumerate(shifts):
        start, end = CORNERS[side], CORNERS[(side + 1) % 4]
        row, column = np.nonzero(full & ~neighbour)
        for i, k in zip(row.tolist(), column.tolist(), strict=True):
            _add(edges, (i + start[0]) * n + k + start[1], (i + end[0]) * n + k + end[1])


def _share(face: int, labels: IntArray, crossings: Crossings, row: int, column: int) -> list[int]:
    """Polygon of a face's share of a cell: its corners, and the crossings on sides to other faces."""
    m, n = labels.shape
    out: list[int] = []
    for side in range(4):
        a, b = CORNERS[side], CORNERS[(side + 1) % 4]
        here, there = labels[row + a[0], column + a[1]], labels[row + b[0], column + b[1]]
        if here == face:
            out.append((row + a[0]) * n + column + a[1])
        if (here == face) != (there == face):
            first, kind = SIDES[side]
            number = (crossings.along if kind == "along" else crossings.across)[row + first[0], column + first[1]]
            if number >= 0:
                out.append(m * n + int(number))
    return out


def chain(edges: dict[tuple[int, int], int]) -> list[list[int]]:
    """Closed loops of directed edges."""
    following: dict[int, list[int]] = defaultdict(list)
    for (a, b), count in sorted(edges.items()):
        following[a] += [b] * count
    loops = []
    for start in sorted(following):
        while following[start]:
            loop, at = [start], following[start].pop()
            while at != start:
                loop.append(at)
                at = following[at].pop()
            loops.append(loop)
    return loops
