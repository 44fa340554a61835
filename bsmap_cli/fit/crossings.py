"""Where two faces meet between neighbouring beams of different faces."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.feet import Table, offsets, tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.model import Array, IntArray

STEPS = 8
EXACT = 1e-9
"""Metres; a step of Newton's method below this is the last one."""
SETTLED = 2e-4
"""Metres to both surfaces within which a point is on them."""
SHARE = 0.05
"""Of the angle between two beams, by which a crossing may lie outside."""
FARTHEST = 2.0
"""Times the distance of the two ends, that the way over the crossing may be, beyond twice the noise."""
FLATTEST = 0.02
"""Sine of the smallest angle at which two faces cross."""


class Crossings(NamedTuple):
    """Meeting points of faces on edges of the grid of beams.

    along, across : (m, n) number of the crossing on the edge to the next beam, to the next scan; -1 for none.
     points : (k, 3) in map.  faces : (k, 2) of the beam itself and of the next one.
    passed : (k, 2) whether the scan that hits the other face passes through this one: it ends before the crossing.
    widths : (k,) metres of the bracket of a rim, in which one face ends (the other is -1); 0 for crossings.
    """

    along: IntArray
    across: IntArray
    points: Array
    faces: IntArray
    passed: NDArray[np.bool_]
    widths: Array

    def reached(self, face: int, number: IntArray) -> NDArray[np.bool_]:
        """Whether a face reaches crossings (j,)."""
        own = self.faces[number] == face
        return np.any(own, axis=1) & ~np.any(own & self.passed[number], axis=1)


def find_crossings(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField]) -> Crossings:
    """Crossings on all edges between neighbouring beams of two faces."""
    numbers, points, faces, count = [], [], [], 0
    table = tabulate(fields)
    for step in ((0, 1), (1, 0)):
        number = np.full(labels.shape, -1)
        found, at, pair = _on_edges(grid, labels, table, step)
        number[found] = count + np.arange(len(at))
        count += len(at)
        numbers.append(number)
        points.append(at)
        faces.append(pair)
    pairs = np.concatenate(faces)
    passed, widths = np.zeros(pairs.shape, dtype=bool), np.zeros(len(pairs))
    return Crossings(numbers[0], numbers[1], np.concatenate(points), pairs, passed, widths)


def _on_edges(
    grid: BeamGrid, labels: IntArray, table: Table, step: tuple[int, int]
) -> tuple[tuple[IntArray, IntArray], Array, IntArray]:
    """First beams (row, column) of the edges with a crossing, the points (k, 3), the two faces (k, 2)."""
    m, n = labels.shape
    a, b = labels[: m - step[0], : n - step[1]], labels[step[0] :, step[1] :]
    hit = grid.hit[: m - step[0], : n - step[1]] & grid.hit[step[0] :, step[1] :]
    row, column = np.nonzero((a != b) & (a >= 0) & (b >= 0) & hit)
    pair = np.column_stack([a[row, column], b[row, column]])
    ends = [_beam(grid, row, column), _beam(grid, row + step[0], column + step[1])]
    points, good = _meet(table, pair, ends[0], ends[1], grid.sigma)
    return (row[good], column[good]), points[good], pair[good]


def _beam(grid: BeamGrid, row: IntArray, column: IntArray) -> tuple[Array, Array]:
    """Ends and directions (k, 3) of beams."""
    return grid.points[row, column], grid.directions[row, column]


def _meet(
    table: Table,
    pair: IntArray,
    first: tuple[Array, Array],
    second: tuple[Array, Array],
    sigma: float,
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (k, 3) on both faces and in the plane of the two beams, by Newton's method; and which lie between them.

    Not along beams between the two: where a pillar ends at a wall such a beam grazes it.
    """
    (p0, d0), (p1, d1) = first, second
    way = p1 - p0
    across = np.cross(d0 + d1, way)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    points = (p0 + p1) / 2.0
    reach = np.maximum(np.linalg.norm(way, axis=1), 4.0 * sigma)
    for _ in range(STEPS):
        values, normals = _offsets(table, pair, points)
        J = np.stack([normals[0], normals[1], across], axis=1)
        off_plane = np.sum((points - p0) * across, axis=1)
        determinant = np.linalg.det(J)
        crossing = np.abs(determinant) > FLATTEST
        J[~crossing] = np.eye(3)
        right = np.column_stack([*values, off_plane])
        step = np.where(crossing[:, None], np.linalg.solve(J, right[:, :, None])[:, :, 0], 0.0)
        length = np.maximum(np.linalg.norm(step, axis=1), 1e-12)
        points = points - step * np.minimum(1.0, reach / length)[:, None]
        if length.max(initial=0.0) < EXACT:
            break
    values, _ = _offsets(table, pair, points)
    settled = crossing & (np.max(np.abs(values), axis=0) < SETTLED)
    lengths = np.linalg.norm(points - p0, axis=1) + np.linalg.norm(points - p1, axis=1)
    near = lengths < FARTHEST * np.linalg.norm(way, axis=1) + 2.0 * sigma
    return points, settled & near & _between(points, first, second)


def _between(points: Array, first: tuple[Array, Array], second: tuple[Array, Array]) -> NDArray[np.bool_]:
    """Whether points lie in the strip between two beams: to the right of one and to the left of the other."""
    (p0, d0), (p1, d1) = first, second
    side = p1 - p0 - np.sum((p1 - p0) * d0, axis=1, keepdims=True) * d0
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-12)
    from_first = np.sum((points - p0) * side, axis=1)
    # The second beam at the depth of the point.
    depth = np.sum((points - p1) * d0, axis=1) / np.maximum(np.sum(d1 * d0, axis=1), 0.1)
    width = np.sum((p1 + depth[:, None] * d1 - p0) * side, axis=1)
    share = from_first / np.where(np.abs(width) > 1e-9, width, 1e-9)
    return np.asarray((share > -SHARE) & (share < 1.0 + SHARE))


def _offsets(table: Table, pair: IntArray, points: Array) -> tuple[Array, Array]:
    """(2, k) heights of points above both faces, over the gradient's length, and (2, k, 3) unit normals."""
    value, normal = offsets(table, pair.T.ravel(), np.concatenate([points, points]))
    return value.reshape(2, -1), normal.reshape(2, -1, 3)
