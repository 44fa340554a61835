"""Triangles of a B-spline surface, fine where it curves, within a tolerance.

The surface is sampled on a grid of parameters that holds all its knots, each span divided into equal steps. Over a
triangle with legs a and b along u and v its distance to the surface is at most (Filip, Magedson and Markot 1986,
"Surface algorithms using bounds on derivatives", theorem 1)

    1/8 (a^2 max|S_uu| + 2 a b max|S_uv| + b^2 max|S_vv|),

and the control points of S_uu, S_uv, S_vv bound these (convex hull). The bound tells where to divide; what distance is
left is measured. Surfaces that meet in a crease of the map have its points there, both the same.
"""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import Surface, evaluate_grid
from bsmap_cli.errors import ParameterError
from bsmap_cli.export.borders import Border, borders
from bsmap_cli.export.trimmed import triangulate
from bsmap_cli.model import Array, BSplineSurface, IntArray, SurfaceMap
from bsmap_cli.track import Track, silent

MOST_POINTS = 10_000_000
"""Points of one surface; beyond it a tolerance is refused, for no viewer shows the mesh and memory runs out."""

MARGIN = 1.25
"""On measured distances, for what lies between the points of measurement."""

SPANNED = 1.5
"""Steps of the grid that triangles between the grid and a trimmed border span; the distance grows with the square."""

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
    """Mesh within `tolerance` metres of the surface, as measured by `mesh_distance`; its front is S_u x S_v.

    Of a trimmed surface only what lies inside its trims.

    Raises
    ------
    ParameterError
        The tolerance asks for more than `MOST_POINTS` points.
    """
    grid = _grid(surface, tolerance)
    return _mesh(surface, grid, borders([surface], [], [_longest_steps(grid)])[0])


def tessellate_map(surface_map: SurfaceMap, tolerance: float, *, track: Track = silent) -> list[Mesh]:
    """Meshes of all surfaces as of `tessellate`; along creases both surfaces have the very same vertices."""
    surfaces = surface_map.surfaces
    grids = []
    for done, surface in enumerate(surfaces):
        track("surfaces", done, len(surfaces))
        grids.append(_grid(surface, tolerance))
    found = borders(surfaces, surface_map.creases, [_longest_steps(grid) for grid in grids])
    track("surfaces", len(surfaces), len(surfaces))
    return [_mesh(*each) for each in zip(surfaces, grids, found, strict=True)]


def _grid(surface: BSplineSurface, tolerance: float) -> tuple[Array, Array]:
    return grid_parameters(surface, tolerance / SPANNED**2 if surface.trims else tolerance)


def _longest_steps(grid: tuple[Array, Array]) -> Array:
    return np.array([np.diff(parameters).max() for parameters in grid])


def _mesh(surface: BSplineSurface, grid: tuple[Array, Array], border: list[Border]) -> Mesh:
    if surface.trims:
        return _without_slivers(*triangulate(surface, border, *grid))
    points = evaluate_grid(surface, *grid)
    return _without_slivers(points.reshape(-1, 3), _grid_triangles(len(grid[0]), len(grid[1])))


def grid_parameters(surface: BSplineSurface, tolerance: float) -> tuple[Array, Array]:
    """Ascending parameters along u and v, all knots among them, of a grid whose mesh keeps the tolerance.

    The bound also counts what slides along the surface, so that it asks for some three times too many triangles. How
    much of it is distance is measured in each knot span on the grid that the bound gives; both shrink with the square
    of the step, so the share found holds for a coarser grid, too. That grid is measured in turn, and where it fails the
    share rises; at 1 the bound holds for certain, so this ends.
    """
    bounds = second_derivative_bounds(surface)
    share = _measure(surface, bounds, np.ones_like(bounds.uu), tolerance).share
    while True:
        grid = _measure(surface, bounds, share, tolerance)
        higher = np.where(grid.distance > tolerance, np.maximum(share, grid.share), share)
        if np.array_equal(higher, share):
            return grid.u, grid.v
        share = higher


class _Measured(NamedTuple):
    """Grid; in each knot span the largest distance of the mesh, and its share of the bound (with MARGIN, up to 1)."""

    u: Array
    v: Array
    distance: Array
    share: Array


def _measure(surface: BSplineSurface, bounds: Bounds, share: Array, tolerance: float) -> _Measured:
    """Grid by `share` of the bounds, and what distance its mesh has."""
    edges_u, edges_v = np.unique(surface.knots_u), np.unique(surface.knots_v)
    steps_u, steps_v = _fewest_steps(surface.name, edges_u, edges_v, Bounds(*(share * b for b in bounds)), tolerance)
    u, v = _divide(edges_u, steps_u), _divide(edges_v, steps_v)
    distance = _largest_in_spans(mesh_distance(surface, u, v), steps_u, steps_v)
    bound = _bound_error(bounds, edges_u, edges_v, steps_u, steps_v)
    ratio = np.divide(MARGIN * distance, bound, out=np.zeros_like(bound), where=bound > 0.0)
    return _Measured(u, v, distance, np.minimum(ratio, 1.0))


def _bound_error(bounds: Bounds, edges_u: Array, edges_v: Array, steps_u: IntArray, steps_v: IntArray) -> Array:
    a, b = (np.diff(edges_u) / steps_u)[:, None], np.diff(edges_v) / steps_v
    return np.asarray((a**2 * bounds.uu + 2.0 * a * b * bounds.uv + b**2 * bounds.vv) / 8.0)


def _fewest_steps(
    name: str, edges_u: Array, edges_v: Array, bounds: Bounds, tolerance: float
) -> tuple[IntArray, IntArray]:
    """Steps in each span of u and of v that bring the bound below the tolerance, found one by one."""
    steps_u, steps_v = np.ones(len(edges_u) - 1, dtype=np.int64), np.ones(len(edges_v) - 1, dtype=np.int64)
    while True:
        error = _bound_error(bounds, edges_u, edges_v, steps_u, steps_v)
        i, j = np.unravel_index(np.argmax(error), error.shape)
        if error[i, j] <= tolerance:
            return steps_u, steps_v
        if (steps_u.sum() + 1) * (steps_v.sum() + 1) > MOST_POINTS:
            raise ParameterError(
                f"a tolerance of {tolerance} m needs more than {MOST_POINTS} points for surface {name}; "
                "choose a larger one"
            )
        a, b = (edges_u[i + 1] - edges_u[i]) / steps_u[i], (edges_v[j + 1] - edges_v[j]) / steps_v[j]
        if a**2 * bounds.uu[i, j] >= b**2 * bounds.vv[i, j]:
            steps_u[i] += 1 + steps_u[i] // 8
        else:
            steps_v[j] += 1 + steps_v[j] // 8


def mesh_distance(surface: Surface, u: Array, v: Array) -> Array:
    """Distance (n - 1, m - 1) of each grid cell's middle, and of the middles of its sides, to its two triangles."""
    points = evaluate_grid(surface, _with_middles(u), _with_middles(v))
    low, middle, high = slice(None, -1, 2), slice(1, None, 2), slice(2, None, 2)
    lower = points[low, low], points[high, low], points[high, high]
    upper = points[low, low], points[high, high], points[low, high]
    centre = points[middle, middle]
    found = [np.minimum(triangle_distance(centre, *lower), triangle_distance(centre, *upper))]
    found += [triangle_distance(side, *lower) for side in (points[middle, low], points[high, middle])]
    found += [triangle_distance(side, *upper) for side in (points[middle, high], points[low, middle])]
    return np.asarray(np.max(found, axis=0))


def triangle_distance(p: Array, a: Array, b: Array, c: Array) -> Array:
    """Distance (...) of points p (..., 3) to triangles a b c, each (..., 3): to the plane above it, else to an edge."""
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=-1)
    edges = [(a, b), (b, c), (c, a)]
    inside = np.all([np.sum(np.cross(e - s, p - s) * normal, axis=-1) >= 0.0 for s, e in edges], axis=0) & (area > 0.0)
    height = np.abs(np.sum((p - a) * normal, axis=-1)) / np.where(area > 0.0, area, 1.0)
    return np.where(inside, height, np.min([_segment_distance(p, s, e) for s, e in edges], axis=0))


def _segment_distance(p: Array, start: Array, end: Array) -> Array:
    along, length = end - start, np.sum((end - start) ** 2, axis=-1)
    t = np.clip(np.sum((p - start) * along, axis=-1) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    return np.asarray(np.linalg.norm(p - start - t[..., None] * along, axis=-1))


def _with_middles(grid: Array) -> Array:
    return np.insert(grid, np.arange(1, len(grid)), (grid[1:] + grid[:-1]) / 2.0)


def _largest_in_spans(cells: Array, steps_u: IntArray, steps_v: IntArray) -> Array:
    """Largest value of the cells in each knot span."""
    starts_u, starts_v = np.cumsum(steps_u) - steps_u, np.cumsum(steps_v) - steps_v
    return np.asarray(np.maximum.reduceat(np.maximum.reduceat(cells, starts_u, axis=0), starts_v, axis=1))


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
