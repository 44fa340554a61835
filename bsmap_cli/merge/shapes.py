"""What topology asks of a face's surface: how far points are above it, and at which parameters. Over planes the height
field tells, of other faces the spline itself."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from bsmap_cli.core.bspline import evaluate_grid, evaluate_surface
from bsmap_cli.fit.heights import HeightField, offset
from bsmap_cli.merge.bases import places_on
from bsmap_cli.model import Array, BSplineSurface

GRID = 40
"""Samples along u and along v from which the nearest parameters are searched."""
STEPS = 8
CLOSED = 0.01
"""Metres between the first and the last line of a surface that goes all around, at most."""
SETTLED = 1e-12
"""Squared change of the parameters below which a step is the last one."""


class SplineShape(NamedTuple):
    """A surface and samples on it: parameters (n, 2), points (n, 3)."""

    surface: BSplineSurface
    parameters: Array
    points: Array


Shape = HeightField | SplineShape


def spline_shape(surface: BSplineSurface) -> SplineShape:
    """Samples of a surface over any base."""
    at = np.linspace(0.0, 1.0, GRID)
    parameters = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)
    return SplineShape(surface, parameters, evaluate_grid(surface, at, at).reshape(-1, 3))


def parameters_of(shape: Shape, points: Array) -> Array:
    """(n, 2) parameters of the nearest places to points (n, 3); of a height field beyond [0, 1] where they are."""
    if isinstance(shape, HeightField):
        return shape.parameters(shape.base.local(points))
    return _nearest(shape, points)[0]


def flattened(shape: Shape, points: Array) -> Array:
    """(n, 2) parameters of the nearest places to points (n, 3), in about metres."""
    if isinstance(shape, HeightField):
        return shape.base.local(points)[:, :2]
    return parameters_of(shape, points) * lengths_of(shape)


def placed(shape: Shape, flat: Array) -> Array:
    """(n, 3) points on a surface at flattened places (n, 2)."""
    if isinstance(shape, HeightField):
        return places_on(shape, (flat - shape.low) / (shape.high - shape.low))
    return evaluate_surface(shape.surface, *np.clip(flat / lengths_of(shape), 0.0, 1.0).T)


def parameters_along(shape: Shape, ring: Array) -> Array:
    """(n, 2) parameters of a closed line (n, 3) on a surface; where that closes on itself, at the end on which the line
    comes and goes.

    A corner at which u begins again lies at both of its ends: which is nearer is chance.
    """
    uv = parameters_of(shape, ring)
    if isinstance(shape, HeightField) or not _closes(shape):
        return uv
    slit = CLOSED / lengths_of(shape)[0]
    off = np.flatnonzero((uv[:, 0] > slit) & (uv[:, 0] < 1.0 - slit))
    if len(off):
        number = np.searchsorted(off, np.arange(len(uv)))
        ends = np.rint(uv[off, 0])
        before, behind = ends[number - 1], ends[number % len(off)]
        beside = np.abs(uv[:, 0] - before) > 1.0 - slit
        uv[(before == behind) & beside, 0] = before[(before == behind) & beside]
    return uv


def flattened_ring(shape: Shape, ring: Array) -> Array:
    """(n, 2) parameters along a closed line (n, 3) on a surface, in about metres."""
    if isinstance(shape, HeightField):
        return flattened(shape, ring)
    return parameters_along(shape, ring) * lengths_of(shape)


def _closes(shape: SplineShape) -> bool:
    """Whether a surface goes all around, and u begins where it ends."""
    grid = shape.points.reshape(GRID, GRID, 3)
    return bool(np.linalg.norm(grid[0] - grid[-1], axis=1).max() < CLOSED)


def lengths_of(shape: SplineShape) -> Array:
    """(2,) metres about along u and along v."""
    grid = shape.points.reshape(GRID, GRID, 3)
    return np.array([np.linalg.norm(np.diff(grid, axis=axis), axis=2).sum(axis=axis).max() for axis in (0, 1)])


def above(shape: Shape, points: Array) -> tuple[Array, Array]:
    """Heights (n,) of points (n, 3) above a surface, about their distances, and unit normals (n, 3) there.

    Beyond its ends it goes on straight.
    """
    if isinstance(shape, HeightField):
        return offset(shape, points)
    _, at, by_u, by_v = _nearest(shape, points)
    normals = np.cross(by_u, by_v)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    return np.sum((points - at) * normals, axis=1), normals


def _nearest(shape: SplineShape, points: Array) -> tuple[Array, Array, Array, Array]:
    """Nearest places by Newton's method: parameters (n, 2), points and derivatives by u and v (n, 3)."""
    uv = shape.parameters[cKDTree(shape.points).query(points)[1]]
    for _ in range(STEPS):
        at, by_u, by_v = evaluate_surface(shape.surface, uv[:, 0], uv[:, 1], 1)
        J = np.stack([by_u, by_v], axis=2)
        step = np.linalg.pinv(J) @ (points - at)[..., None]
        new = np.clip(uv + step[..., 0], 0.0, 1.0)
        done = np.sum((new - uv) ** 2, axis=1).max(initial=0.0) < SETTLED
        uv = new
        if done:
            break
    at, by_u, by_v = evaluate_surface(shape.surface, uv[:, 0], uv[:, 1], 1)
    return uv, at, by_u, by_v
