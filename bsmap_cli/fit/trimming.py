"""Trim loops of faces and the creases that they share."""

import itertools
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
from bsmap_cli.fit.feet import Feet, Table, parameters_at, tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.fit.labels import met_at, places_of_faces
from bsmap_cli.fit.outline import Nodes, outlines
from bsmap_cli.fit.rims import straightened, with_rims
from bsmap_cli.model import Array, IntArray, TrimLoop

BORDER_TOLERANCE, CREASE_TOLERANCE = 0.004, 0.001
"""Metres by which a simplified line may leave the outline."""
STEP = 2
"""Beams on the way from a rim in one scan to that in the next one, at most."""
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
    crossings = with_rims(clean, faces.labels, table, crossings)
    believed = ~(doubtful | beyond_bare_ends(clean, faces.labels, fields, ends))
    nodes = _nodes(grid, faces.labels, table, fields, feet, crossings)
    pairs = crossings.faces.min(axis=1) * len(fields) + crossings.faces.max(axis=1)
    pairs[crossings.passed.any(axis=1)] = -1
    rim = crossings.widths > 0.0
    pairs[rim] = len(fields) ** 2 + crossings.faces[rim].max(axis=1)
    sides = _Sides(nodes, pairs, crossings.points, crossings.widths, {}, [])
    loops = []
    for number, around in enumerate(outlines(len(fields), faces.labels, crossings, nodes, believed)):
        size = fields[number].high - fields[number].low
        made = (_loop(sides, number, size, np.array(vertices)) for vertices in around)
        loops.append([loop for loop in made if loop is not None])
    return Trims(loops, sides.lines)


def _nodes(
    grid: BeamGrid,
    labels: IntArray,
    table: Table,
    fields: Sequence[HeightField],
    feet: Sequence[Feet],
    crossings: Crossings,
) -> Nodes:
    """Parameters of beams and crossings; of beams without return between others of their face, by these."""
    m, n = labels.shape
    uv, beyond = np.full((m * n, 2), np.nan), np.zeros(m * n)
    for at, of_face in zip(places_of_faces(grid, labels, len(fields)), feet, strict=True):
        uv[at], beyond[at] = of_face.uv, of_face.beyond
    short = np.flatnonzero(_stand_on(grid, labels, table).ravel() & (beyond > 0.0))
    uv[short] = parameters_at(table, labels.ravel()[short], grid.points.reshape(-1, 3)[short])
    missing = np.flatnonzero((labels >= 0) & ~grid.hit)
    before, behind = (grid.before.place[grid.before.number[missing] - k] for k in (1, 0))
    share = ((missing - before) / (behind - before))[:, None]
    uv[missing] = (1.0 - share) * uv[before] + share * uv[behind]
    pair = np.where(crossings.faces < 0, crossings.faces.max(axis=1, keepdims=True), crossings.faces).ravel()
    at_crossings = parameters_at(table, pair, np.repeat(crossings.points, 2, axis=0))
    return Nodes(uv.reshape(m, n, 2), at_crossings.reshape(-1, 2, 2), crossings.faces)


def _stand_on(grid: BeamGrid, labels: IntArray, table: Table) -> NDArray[np.bool_]:
    """(m, n) beams whose neighbour in the scan hits something in front of their face.

    What stands on the face may begin at the beam itself: a foot behind the measured point is no part of the face.
    """
    out = np.zeros(labels.shape, dtype=bool)
    last = labels[:, :-1] != labels[:, 1:]
    for own, following in ((0, 1), (1, 0)):
        face, hit = (of[:, k : k + last.shape[1]] for of, k in ((labels, own), (grid.hit, following)))
        row, column = np.nonzero(last & (face >= 0) & hit)
        met = met_at(grid, table, labels[row, column + own], row, column + following)
        out[row, column + own] |= met.beyond > 0.0
    return out


class _Sides(NamedTuple):
    """What turning loops of numbers into polygons needs; `creases` and `lines` grow.

    pairs : (k,) of each crossing the two faces, as one number; -1 where one of them ends before.  points : (k, 3).
    widths : (k,) of rims.
    """

    nodes: Nodes
    pairs: IntArray
    points: Array
    widths: Array
    creases: dict[tuple[int, ...], int]
    lines: list[CreaseLine]

    @property
    def first(self) -> int:
        """Number of the first crossing among vertices."""
        return self.nodes.beams.shape[0] * self.nodes.beams.shape[1]

    def pairs_of(self, vertices: IntArray) -> IntArray:
        """(j,) pairs of faces of vertices (j,); -1 for beams."""
        out = np.full(len(vertices), -1)
        crossing = vertices >= self.first
        out[crossing] = self.pairs[vertices[crossing] - self.first]
        return out


def _loop(sides: _Sides, face: int, size: Array, vertices: IntArray) -> TrimLoop | None:
    """Loop with simplified sides; None where little is left.  size : (2,) metres of the face's rectangle."""
    if abs(signed_area(sides.nodes.at(face, vertices) * size)) < LEAST_AREA:
        return None
    vertices = _along_rims(sides, vertices)
    made = [_line(sides, face, size, run, pair) for run, pair in _runs(sides, vertices)]
    at = np.concatenate([line.at for line in made])
    if len(at) < 3:
        return None
    # The side from the end of a line to the next one's beginning follows nothing.
    marks, rims = (
        np.concatenate([np.append(np.full(len(line.at) - 1, line[k]), none) for line in made if len(line.at)])
        for k, none in ((1, -1), (2, 0.0))
    )
    return TrimLoop(np.clip(at, 0.0, 1.0), marks.astype(np.int64), rims if rims.any() else None)


class _Line(NamedTuple):
    """Part of a loop: parameters (k, 2), the crease that it runs along or -1, metres of its bracket if it is a rim."""

    at: Array
    crease: int
    rim: float


def _line(sides: _Sides, face: int, size: Array, run: IntArray, pair: int) -> _Line:
    """A stretch of a loop with few vertices."""
    at = sides.nodes.at(face, run)
    if pair >= 0 and len(run) > 1:
        widths = sides.widths[run - sides.first]
        if not widths.any():
            number, line = _crease(sides, run)
            return _Line(sides.nodes.at(face, line), number, 0.0)
        return _Line(straightened(at * size, widths) / size, -1, float(widths.mean()))
    return _Line(at[simplify(at * size, BORDER_TOLERANCE)], -1, 0.0)


def _along_rims(sides: _Sides, vertices: IntArray) -> IntArray:
    """The vertices of a loop without beams between two rims: from scan to scan the last beam's number changes."""
    rim = np.zeros(len(vertices), dtype=bool)
    crossing = vertices >= sides.first
    rim[crossing] = sides.widths[vertices[crossing] - sides.first] > 0.0
    rims = np.flatnonzero(rim)
    keep = np.ones(len(vertices), dtype=bool)
    for start, stop in itertools.pairwise([*rims.tolist(), *(rims[:1] + len(rim)).tolist()]):
        between = np.arange(start + 1, stop) % len(rim)
        keep[between] = len(between) > STEP or bool(crossing[between].any())
    return vertices[keep]


def _runs(sides: _Sides, vertices: IntArray) -> list[tuple[IntArray, int]]:
    """Stretches of a loop along one crease or one open border; a loop of one kind begins at its lowest number."""
    pairs = sides.pairs_of(vertices)
    changes = np.flatnonzero(pairs != np.roll(pairs, 1))
    start = int(changes[0] if len(changes) else np.argmin(vertices))
    vertices, pairs = np.roll(vertices, -start), np.roll(pairs, -start)
    if not len(changes):
        half, pair = len(vertices) // 2, int(pairs[0])
        if pair < 0:
            return [(vertices[:half], -1), (vertices[half:], -1)]
        return [(vertices[: half + 1], pair), (np.append(vertices[half:], vertices[0]), pair)]
    cuts = np.flatnonzero(np.diff(pairs)) + 1
    return list(zip(np.split(vertices, cuts), pairs[[0, *cuts]].tolist(), strict=True))


def _crease(sides: _Sides, run: IntArray) -> tuple[int, IntArray]:
    """Number of the crease along a run of crossings, and those of its vertices that stay; the same from both faces."""
    turned = run[0] > run[-1]
    line = run[::-1] if turned else run
    key = tuple(line.tolist())
    points = sides.points[line - sides.first]
    keep = simplify(points, CREASE_TOLERANCE)
    if key not in sides.creases:
        a, b = np.sort(sides.nodes.faces[line[0] - sides.first]).tolist()
        sides.creases[key] = len(sides.lines)
        sides.lines.append(CreaseLine((a, b), points[keep]))
    return sides.creases[key], line[keep][::-1] if turned else line[keep]
