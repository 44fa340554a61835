"""Triangles of a B-spline surface, fine where it curves, within a tolerance that holds for certain.

The surface is sampled on a grid of parameters that holds all its knots, each span divided into equal steps. Over a
triangle with legs a and b along u and v its distance to the surface is at most (Filip, Magedson and Markot 1986,
"Surface algorithms using bounds on derivatives", theorem 1)

    1/8 (a^2 max|S_uu| + 2 a b max|S_uv| + b^2 max|S_vv|),

and the control points of S_uu, S_uv, S_vv bound these (convex hull). Neighbouring surfaces are divided each on its own:
where they share an edge, the two rows of triangles meet within the tolerance, not point by point.
"""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import Surface, evaluate_grid
from bsmap_cli.errors import ParameterError
from bsmap_cli.model import Array, BSplineSurface, IntArray

MOST_POINTS = 10_000_000
"""Points of one surface; beyond it a tolerance is refused, for no viewer shows the mesh and memory runs out."""

SLIVER = 1e-9
"""Metres; a triangle less high than this is dropped (where the edge of a surface shrinks to a point)."""


class Mesh(NamedTuple):
    """vertices (n, 3) metres in map; triangles (m, 3), counter-clockwise seen from the front."""

    vertices: Array
    triangles: IntArray


class Bounds(NamedTuple):
    """Largest |S_uu|, |S_uv|, |S_vv| in each of the (a, b) knot spans."""

    uu: Array
    uv: Array
    vv: Array


def tessellate(surface: BSplineSurface, tolerance: float) -> Mesh:
    """Mesh no farther than `tolerance` metres from the surface, nor the surface from it; front is S_u x S_v.

    Raises
    ------
    ParameterError
        The tolerance asks for more than `MOST_POINTS` points.
    """
    u, v = grid_parameters(surface, tolerance)
    points = evaluate_grid(surface, u, v)
    return _without_slivers(points.reshape(-1, 3), _grid_triangles(len(u), len(v)))


def grid_parameters(surface: BSplineSurface, tolerance: float) -> tuple[Array, Array]:
    """Ascending parameters along u and v, all knots among them, that keep the bound below the tolerance."""
    edges_u, edges_v = np.unique(surface.knots_u), np.unique(surface.knots_v)
    bounds = second_derivative_bounds(surface)
    steps_u, steps_v = np.ones(len(edges_u) - 1, dtype=int), np.ones(len(edges_v) - 1, dtype=int)
    while True:
        a, b = (np.diff(edges_u) / steps_u)[:, None], np.diff(edges_v) / steps_v
        along_u, twist, along_v = a**2 * bounds.uu, a * b * bounds.uv, b**2 * bounds.vv
        error = (along_u + 2.0 * twist + along_v) / 8.0
        i, j = np.unravel_index(np.argmax(error), error.shape)
        if error[i, j] <= tolerance:
            return _divide(edges_u, steps_u), _divide(edges_v, steps_v)
        if (steps_u.sum() + 1) * (steps_v.sum() + 1) > MOST_POINTS:
            raise ParameterError(
                f"a tolerance of {tolerance} m needs more than {MOST_POINTS} points for surface {surface.name}; "
                "choose a larger one"
            )
        if along_u[i, j] >= along_v[i, j]:
            steps_u[i] += 1 + steps_u[i] // 8
        else:
            steps_v[j] += 1 + steps_v[j] // 8


def second_derivative_bounds(surface: Surface) -> Bounds:
    """Bounds of the second derivatives in each knot span, from the control points of the derived surfaces."""
    return Bounds(*(_bound(surface, orders) for orders in ((2, 0), (1, 1), (0, 2))))


def _bound(surface: Surface, orders: tuple[int, int]) -> Array:
    knots, degrees = (surface.knots_u, surface.knots_v), (surface.degree_u, surface.degree_v)
    spans = [np.flatnonzero(np.diff(k) > 0.0) for k in knots]
    if orders[0] > degrees[0] or orders[1] > degrees[1]:
        return np.zeros((len(spans[0]), len(spans[1])))
    points = surface.control_points
    for axis in (0, 1):
        points = _derive(knots[axis], degrees[axis], points, axis, orders[axis])
    size = np.linalg.norm(points, axis=2)
    # The order-th derivative has degree - order + 1 functions that are not zero in span mu; the first is mu - degree.
    for axis in (0, 1):
        windows = [np.arange(mu - degrees[axis], mu - orders[axis] + 1) for mu in spans[axis]]
        size = np.stack([size.take(window, axis).max(axis) for window in windows], axis)
    return size


def _derive(knots: Array, degree: int, points: Array, axis: int, order: int) -> Array:
    """Control points of the order-th derivative along an axis, on the same knots without the outer ones."""
    points = np.moveaxis(points, axis, 0)
    for d in range(1, order + 1):
        width = knots[degree + 1 : len(knots) - d] - knots[d : len(knots) - degree - 1]
        # A function over an empty interval (a knot of full multiplicity) is zero everywhere: its point does not count.
        factor = np.divide(degree + 1 - d, width, out=np.zeros_like(width), where=width > 0.0)
        points = np.diff(points, axis=0) * factor[:, None, None]
    return np.moveaxis(points, 0, axis)


def _divide(edges: Array, steps: IntArray) -> Array:
    """The edges, and steps - 1 equidistant parameters between each two of them."""
    position = np.concatenate([np.arange(n) / n + i for i, n in enumerate(steps)] + [[float(len(steps))]])
    return np.interp(position, np.arange(len(edges)), edges)


def _grid_triangles(rows: int, columns: int) -> IntArray:
    """(2 (rows - 1) (columns - 1), 3) triangles of a grid whose points are numbered row by row."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    below, right = corner + columns, corner + 1
    pairs = [np.stack([corner, below, below + 1], 1), np.stack([corner, below + 1, right], 1)]
    return np.stack(pairs, 1).reshape(-1, 3)


def _without_slivers(vertices: Array, triangles: IntArray) -> Mesh:
    corners = vertices[triangles]
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    kept = triangles[doubled > SLIVER * np.maximum(sides, SLIVER)]
    used, renumbered = np.unique(kept, return_inverse=True)
    return Mesh(vertices[used], renumbered.reshape(-1, 3))
