"""Triangles of a trimmed surface: Delaunay of its trim loops and of grid points inside, without what lies outside.

Sides of the loops that the triangulation lacks are halved until it has them (conforming Delaunay triangulation).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, cKDTree

from bsmap_cli.core.trims import inside_trims
from bsmap_cli.model import Array, BSplineSurface, IntArray

ROUNDS = 10
"""Of halving; loops that overlap cross each other, which no halving ends."""
NEAR = 0.3
"""Of a step of the grid: points of the grid nearer to the outline than this are left out."""


def triangulate(surface: BSplineSurface, u: Array, v: Array) -> tuple[Array, IntArray]:
    """Parameters (n, 2) and triangles (m, 3), counter-clockwise in the parameters, of the trimmed surface.

    u, v : parameters of a grid fine enough for the whole surface.
    """
    scale = _lengths(surface)
    step = np.maximum([np.diff(u).max(), np.diff(v).max()], 1e-9)
    sides = np.concatenate([_sides(loop.parameters, step) for loop in surface.trims])
    points, sides = _numbered(sides)
    grid = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[inside_trims(surface, grid)]
    if len(grid):
        distance = cKDTree(points / step).query(grid / step)[0]
        grid = grid[distance > NEAR]
    points = np.concatenate([points, grid])
    triangles = np.zeros((0, 3), dtype=np.int64)
    for _ in range(ROUNDS):
        triangles = Delaunay(points * scale).simplices.astype(np.int64)
        missing = ~np.isin(_codes(sides, len(points)), _codes(_edges(triangles), len(points)))
        if not missing.any():
            break
        points, sides = _halve(points, sides, missing)
    corners = points[triangles]
    kept = triangles[inside_trims(surface, corners.mean(axis=1))]
    return points, _counter_clockwise(points, kept)


def _lengths(surface: BSplineSurface) -> Array:
    """(2,) metres about along u and along v, so that triangles are well shaped in space."""
    P = surface.control_points
    along_u = np.linalg.norm(np.diff(P, axis=0), axis=2).sum(axis=0).mean()
    along_v = np.linalg.norm(np.diff(P, axis=1), axis=2).sum(axis=1).mean()
    return np.maximum([along_u, along_v], 1e-6)


def _sides(loop: Array, step: Array) -> Array:
    """Sides (k, 2, 2) of a closed polygon, divided where longer than a step of the grid."""
    following = np.roll(loop, -1, axis=0)
    count = np.ceil(np.max(np.abs(following - loop) / step, axis=1) - 1e-9).astype(int).clip(1)
    start = np.repeat(np.arange(len(loop)), count)
    number = np.arange(len(start)) - np.repeat(np.cumsum(count) - count, count)
    ends = [loop[start] + ((number + k) / count[start])[:, None] * (following - loop)[start] for k in (0, 1)]
    return np.stack(ends, axis=1)


def _numbered(sides: Array) -> tuple[Array, IntArray]:
    points, index = np.unique(np.round(sides.reshape(-1, 2), 12), axis=0, return_inverse=True)
    pairs = index.reshape(-1, 2)
    return points, pairs[pairs[:, 0] != pairs[:, 1]]


def _edges(triangles: IntArray) -> IntArray:
    return np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])


def _codes(edges: IntArray, n: int) -> IntArray:
    return np.asarray(edges.min(axis=1) * n + edges.max(axis=1))


def _halve(points: Array, sides: IntArray, which: NDArray[np.bool_]) -> tuple[Array, IntArray]:
    a, b = sides[which].T
    middle = len(points) + np.arange(len(a))
    new = np.concatenate([np.column_stack([a, middle]), np.column_stack([middle, b])])
    return np.concatenate([points, (points[a] + points[b]) / 2.0]), np.concatenate([sides[~which], new])


def _counter_clockwise(points: Array, triangles: IntArray) -> IntArray:
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return np.where((area < 0.0)[:, None], triangles[:, ::-1], triangles)
