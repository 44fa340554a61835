"""Trim loops of faces and the creases that they share."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.polygons import signed_area, simplify
from bsmap_cli.fit.bare_ends import beyond_bare_ends
from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.crossings import Crossings, find_crossings
from bsmap_cli.fit.division import Faces
from bsmap_cli.fit.ends import doubtful_cells, find_ends, on_faces, passed_through, within_ends
from bsmap_cli.fit.feet import Feet, tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.fit.labels import feet_of
from bsmap_cli.fit.outline import outline
from bsmap_cli.model import Array, IntArray, TrimLoop

BORDER_TOLERANCE, CREASE_TOLERANCE = 0.004, 0.001
"""Metres by which a simplified line may leave the outline."""
LEAST_AREA = 4e-4
"""Square metres; smaller loops are dropped."""


class CreaseLine(NamedTuple):
    """Two faces by number, and the points (k, 3) of their crease."""

    faces: tuple[int, int]
    points: Array


class Trims(NamedTuple):
    """Loops of each face, and the creases to which their sides refer."""

    loops: list[list[TrimLoop]]
    creases: list[CreaseLine]


def trim(grid: BeamGrid, faces: Faces, feet: Sequence[Feet]) -> Trims:
    """Outlines of all faces, with few vertices, and creases stored once; feet of the beams of each face."""
    fields = [fitted.field for fitted in faces.fitted]
    crossings = find_crossings(grid, faces.labels, fields)
    ends, table = find_ends(grid, faces.labels, crossings), tabulate(fields)
    clean = on_faces(grid, faces.labels, feet)
    doubtful = doubtful_cells(clean, faces.labels, table, crossings, ends)
    crossings = within_ends(clean, faces.labels, table, crossings, ends)
    crossings = passed_through(clean, faces.labels, table, crossings, ends)
    believed = ~(doubtful | beyond_bare_ends(clean, faces.labels, fields, ends))
    creases: dict[tuple[int, ...], int] = {}
    lines: list[CreaseLine] = []
    loops = []
    for number, field in enumerate(fields):
        uv = _node_parameters(grid, faces.labels, number, field, feet[number])
        at_crossings = field.parameters(field.base.local(crossings.points))
        found = outline(number, faces.labels, crossings, uv, at_crossings, believed)
        sides = _Sides(field, uv.reshape(-1, 2), at_crossings, crossings, creases, lines)
        loops.append([loop for vertices in found.vertices if (loop := _loop(sides, vertices)) is not None])
    return Trims(loops, lines)


def _node_parameters(grid: BeamGrid, labels: IntArray, number: int, field: HeightField, feet: Feet) -> Array:
    """(m, n, 2) parameters of a face's beams; of beams without return between them, by their neighbours."""
    member = labels == number
    uv = np.full((*labels.shape, 2), np.nan)
    seen = member & grid.hit
    short = _stands_on(grid, labels, number, field)[seen] & (feet.beyond > 0.0)
    uv[seen] = np.where(short[:, None], field.parameters(field.base.local(grid.points[seen])), feet.uv)
    for row in np.flatnonzero((member & ~grid.hit).any(axis=1)):
        at, known = np.flatnonzero(member[row] & ~grid.hit[row]), np.flatnonzero(seen[row])
        for axis in (0, 1):
            uv[row, at, axis] = np.interp(at, known, uv[row, known, axis])
    return uv


def _stands_on(grid: BeamGrid, labels: IntArray, number: int, field: HeightField) -> NDArray[np.bool_]:
    """(m, n) beams of a face whose neighbour in the scan hits something in front of it.

    What stands on the face may begin at the beam itself: a foot behind the measured point is no part of the face.
    """
    member = labels == number
    out = np.zeros_like(member)
    for own, next_one in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:, 1:], np.s_[:, :-1])):
        last = np.zeros_like(member)
        last[next_one] = member[own] & ~member[next_one]
        last &= grid.hit
        in_front = np.zeros_like(member)
        in_front[last] = feet_of(grid, field, last).beyond > 0.0
        out[own] |= member[own] & in_front[next_one]
    return out


class _Sides(NamedTuple):
    """What turning a loop of numbers into a polygon needs; `creases` and `lines` grow."""

    field: HeightField
    uv: Array
    at_crossings: Array
    crossings: Crossings
    creases: dict[tuple[int, ...], int]
    lines: list[CreaseLine]

    def parameters(self, vertices: list[int]) -> Array:
        """(k, 2) of beams and crossings."""
        first = len(self.uv)
        return np.array([self.at_crossings[v - first] if v >= first else self.uv[v] for v in vertices])

    def pair(self, vertex: int) -> tuple[int, int] | None:
        """The two faces of a crossing that both reach; None for a beam, or where one ends before."""
        if vertex < len(self.uv) or self.crossings.passed[vertex - len(self.uv)].any():
            return None
        a, b = self.crossings.faces[vertex - len(self.uv)].tolist()
        return (a, b) if a < b else (b, a)


def _loop(sides: _Sides, vertices: list[int]) -> TrimLoop | None:
    """Loop with simplified sides; None where little is left."""
    size = sides.field.high - sides.field.low
    if abs(signed_area(sides.parameters(vertices) * size)) < LEAST_AREA:
        return None
    kept: list[int] = []
    marks: list[int] = []
    for run, pair in _runs(sides, vertices):
        if pair is not None and len(run) > 1:
            number, line = _crease(sides, run, pair)
        else:
            metres = sides.parameters(run) * size
            number, line = -1, [v for v, keep in zip(run, simplify(metres, BORDER_TOLERANCE), strict=True) if keep]
        kept += line
        marks += [number] * (len(line) - 1) + [-1]
    if len(kept) < 3:
        return None
    return TrimLoop(np.clip(sides.parameters(kept), 0.0, 1.0), np.array(marks))


def _runs(sides: _Sides, vertices: list[int]) -> list[tuple[list[int], tuple[int, int] | None]]:
    """Stretches of a loop along one crease or one open border; a loop of one kind begins at its lowest number."""
    pairs = [sides.pair(v) for v in vertices]
    changes = [k for k in range(len(vertices)) if pairs[k] != pairs[k - 1]]
    start = changes[0] if changes else vertices.index(min(vertices))
    vertices, pairs = vertices[start:] + vertices[:start], pairs[start:] + pairs[:start]
    if not changes:
        half = len(vertices) // 2
        closed = [*vertices[half:], vertices[0]]
        return [(vertices[: half + 1], pairs[0]), (closed, pairs[0])] if pairs[0] is not None else _open(vertices)
    out: list[tuple[list[int], tuple[int, int] | None]] = []
    for vertex, pair in zip(vertices, pairs, strict=True):
        if out and out[-1][1] == pair:
            out[-1][0].append(vertex)
        else:
            out.append(([vertex], pair))
    return out


def _open(vertices: list[int]) -> list[tuple[list[int], tuple[int, int] | None]]:
    half = len(vertices) // 2
    return [(vertices[:half], None), (vertices[half:], None)]


def _crease(sides: _Sides, run: list[int], pair: tuple[int, int]) -> tuple[int, list[int]]:
    """Number of the crease along a run of crossings, and those of its vertices that stay; the same from both faces."""
    turned = run[0] > run[-1]
    key = tuple(run[::-1] if turned else run)
    points = sides.crossings.points[np.array(key) - len(sides.uv)]
    kept = [v for v, keep in zip(key, simplify(points, CREASE_TOLERANCE), strict=True) if keep]
    if key not in sides.creases:
        sides.creases[key] = len(sides.lines)
        sides.lines.append(CreaseLine(pair, sides.crossings.points[np.array(kept) - len(sides.uv)]))
    return sides.creases[key], kept[::-1] if turned else kept
