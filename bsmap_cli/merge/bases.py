"""Faces over planes and upright cylinders as merging needs them: height field, what of it is there, samples on it."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import shapely

from bsmap_cli.core.bspline import Surface, evaluate_grid, evaluate_surface
from bsmap_cli.core.sides import side_towards
from bsmap_cli.core.uncertainty import pose_covariance, pose_difference
from bsmap_cli.fit.heights import Base, CylinderBase, HeightField, Knots, PlaneBase, basis_matrix, evaluate
from bsmap_cli.merge.facing import sensor_position
from bsmap_cli.merge.regions import Region, region_of
from bsmap_cli.model import Array, BSplineSurface, HeightCovariance

SAMPLES = 150
"""About so many on a face, but not closer than CLOSEST nor farther apart than FARTHEST, metres."""
CLOSEST, FARTHEST = 0.03, 0.3
LEAST_HEIGHT = 0.3
"""Metres off the base at which a data set's centre tells the side from which it saw a wall."""
LEVEL = 1e-6
"""Largest z of a unit vector that counts as level."""
MIDDLE = np.array([[0.5, 0.5]])
PER_CONTROL_POINT = 6
"""Places for each control point and direction, from which the heights over a cylinder are found."""


class BasedFace(NamedTuple):
    """A trimmed surface over a plane or an upright cylinder.

    region : in s and t of the field's base, metres.  facing : +1 or -1 where the base's normal points to the sensor or
    away, 0 where that is not known.
    samples : (n, 3) in map, those of the border last.  areas : (n,) square metres each stands for, 0 at the border of
    faces that are wide enough.
    variances : (n,) sensor part, square metres.
    """

    surface: BSplineSurface
    field: HeightField
    region: Region
    facing: int
    samples: Array
    areas: Array
    variances: Array

    @property
    def round(self) -> bool:
        """Whether it is over a cylinder."""
        return isinstance(self.field.base, CylinderBase)

    @property
    def area(self) -> float:
        """Square metres."""
        return float(self.region.area)


def has_base(surface: BSplineSurface) -> bool:
    """Whether a surface is a trimmed height field over a plane or over an upright cylinder."""
    covariance = surface.covariance
    if not surface.trims or not isinstance(covariance, HeightCovariance):
        return False
    around, upwards = covariance.directions.shape[:2]
    return upwards == 1 and (around == 1 or bool(np.abs(covariance.directions[..., 2]).max() < LEVEL))


def based_face(surface: BSplineSurface) -> BasedFace | None:
    """The face of a surface for which `has_base` holds; None where nothing of it is left inside its trims."""
    field = field_of(surface)
    size = field.high - field.low
    region = region_of([field.low + loop.parameters * size for loop in surface.trims])
    if region.area <= 0.0:
        return None
    step = float(np.clip(np.sqrt(region.area / SAMPLES), CLOSEST, FARTHEST))
    inner, border = _grid(region, step), shapely.get_coordinates(shapely.segmentize(region.boundary, step))
    st = np.concatenate([inner, border])
    uv = (st - field.low) / size
    samples = field.base.place(np.column_stack([st, evaluate(field, uv)[0]]))
    # In a strip that is hardly wider than the grid the places inside lie in one line, which tells no plane.
    counted = len(st) if _in_line(inner, step) else len(inner)
    areas = np.append(np.full(counted, region.area / counted), np.zeros(len(st) - counted))
    variances = height_variances(surface, field, uv)
    return BasedFace(surface, field, region, _facing(surface, field.base, samples), samples, areas, variances)


def _facing(surface: BSplineSurface, base: Base, samples: Array) -> int:
    """As in BasedFace; by the centre of the data set where the surface does not tell it.

    Passing a corner, a robot sees walls round it from one end of its way, whose middle lies behind them.
    """
    if surface.side:
        return surface.side * base_side(surface, base)
    off = float(base.local(sensor_position(surface))[2] - base.local(samples)[:, 2].mean())
    return 0 if abs(off) < LEAST_HEIGHT else int(np.sign(off))


def base_side(surface: Surface, base: Base) -> int:
    """+1 where S_u x S_v of a surface points along the normal of its base, else -1."""
    return side_towards(surface, MIDDLE, normals(base, evaluate_surface(surface, *MIDDLE.T)))


def _in_line(places: Array, step: float) -> bool:
    """Whether places (n, 2) spread across their main direction by less than half a step."""
    if len(places) < 3:
        return True
    spread = np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[-1]
    return bool(spread < 0.5 * step * np.sqrt(len(places)))


def field_of(surface: BSplineSurface) -> HeightField:
    """Height field of a surface for which `has_base` holds."""
    assert isinstance(surface.covariance, HeightCovariance)
    knots = Knots(surface.degree_u, surface.degree_v, surface.knots_u, surface.knots_v)
    if len(surface.covariance.directions) > 1:
        return _over_cylinder(surface, knots)
    base = _plane_of(surface.control_points, surface.covariance.directions[0, 0])
    local = base.local(surface.control_points)
    return HeightField(base, np.zeros(2), local[-1, -1, :2], knots, local[..., 2])


def _plane_of(P: Array, direction: Array) -> PlaneBase:
    """Plane with its origin at the first of control points (nu, nv, 3), upright on a direction (3,)."""
    n = direction / np.linalg.norm(direction)
    s = _across(P[-1, 0] - P[0, 0], n)
    t = _across(P[0, -1] - P[0, 0], n)
    t = _across(t - (t @ s) * s, n)
    return PlaneBase(P[0, 0], np.column_stack([s, t, n]))


def _over_cylinder(surface: BSplineSurface, knots: Knots) -> HeightField:
    """Heights over the cylinder through a surface, by least squares at places on it."""
    points = evaluate_grid(surface, *(np.linspace(0.0, 1.0, PER_CONTROL_POINT * n) for n in knots.shape))
    base, ends = cylinder_through(points)
    low, high = np.array([ends[0], points[0, 0, 2]]), np.array([ends[1], points[0, -1, 2]])
    field = HeightField(base, low, high, knots, np.zeros(knots.shape))
    local = base.local(points.reshape(-1, 3))
    heights = np.asarray(
        np.linalg.lstsq(basis_matrix(knots, field.parameters(local)), local[:, 2], rcond=None)[0], dtype=np.float64
    )
    return replace(field, heights=heights.reshape(knots.shape))


def cylinder_through(points: Array) -> tuple[CylinderBase, tuple[float, float]]:
    """Upright cylinder through points (n, m, 3) whose rows follow each other around it; s of the first and last row."""
    centre, radius = circle_through(points[..., :2].reshape(-1, 2), np.ones(points.shape[0] * points.shape[1]))
    x, y = (points[:, 0, :2] - centre).T
    angles = np.unwrap(np.arctan2(y, x))
    middle = float(angles[0] + angles[-1]) / 2.0
    first, last = ((angles[[0, -1]] - middle) * radius).tolist()
    return CylinderBase(centre, radius, middle), (first, last)


def circle_through(points: Array, weights: Array) -> tuple[Array, float]:
    """Centre (2,) and radius of the circle through points (n, 2), by least squares of x^2 + y^2 = 2 a x + 2 b y + c."""
    mean = np.average(points, axis=0, weights=weights)
    xy, root = points - mean, np.sqrt(weights)
    rows = np.column_stack([2.0 * xy, np.ones(len(xy))]) * root[:, None]
    a, b, c = np.linalg.lstsq(rows, np.sum(xy * xy, axis=1) * root, rcond=None)[0]
    return mean + np.array([a, b]), float(np.sqrt(c + a * a + b * b))


def height_basis(surface: BSplineSurface, field: HeightField, uv: Array) -> Array:
    """(n, k) by how much the heights of a surface's control points lift it off its base at parameters (n, 2), those
    outside as at the nearest inside: over a cylinder each control point moves along a direction of its own.
    """
    N = basis_matrix(field.knots, uv)
    return (
        N if isinstance(field.base, PlaneBase) else N * _share_along(surface, normals(field.base, places_on(field, uv)))
    )


def _share_along(surface: BSplineSurface, wanted: Array) -> Array:
    """(n, k) cosines between the directions of the control points and unit vectors (n, 3)."""
    assert isinstance(surface.covariance, HeightCovariance)
    directions = np.broadcast_to(surface.covariance.directions, surface.control_points.shape)
    return np.asarray(wanted @ directions.reshape(-1, 3).T)


def places_on(field: HeightField, uv: Array) -> Array:
    """(n, 3) points in map of a field at parameters (n, 2)."""
    st = field.low + uv * (field.high - field.low)
    return field.base.place(np.column_stack([st, evaluate(field, uv)[0]]))


def normals(base: Base, points: Array) -> Array:
    """(n, 3) unit normals of a base at the feet of points (n, 3): along the height, or outwards."""
    return base.normal(base.local(points), np.zeros((len(points), 2)))


def height_variances(surface: BSplineSurface, field: HeightField, uv: Array) -> Array:
    """(n,) sensor part of the heights' variances at parameters (n, 2), those outside as at the nearest inside."""
    assert isinstance(surface.covariance, HeightCovariance)
    N = height_basis(surface, field, uv)
    return np.asarray(np.maximum(np.einsum("ni,ij,nj->n", N, surface.covariance.matrix, N), 0.0))


def pose_variances(face: BasedFace, other: BasedFace, points: Array) -> Array:
    """(n,) variance across the base of `face` that the poses of both give the difference of their points there."""
    both = pose_difference(face.surface.covariance.pose, other.surface.covariance.pose)
    n = normals(face.field.base, points)
    return np.asarray(np.einsum("ni,nij,nj->n", n, pose_covariance(both, points), n))


def _across(vector: Array, normal: Array) -> Array:
    flat = vector - (vector @ normal) * normal
    return np.asarray(flat / np.linalg.norm(flat))


def _grid(region: Region, step: float) -> Array:
    """(n, 2) points of a regular grid inside a region."""
    low_s, low_t, high_s, high_t = region.bounds
    s = np.arange(low_s + step / 2.0, high_s, step)
    t = np.arange(low_t + step / 2.0, high_t, step)
    grid = np.stack(np.meshgrid(s, t, indexing="ij"), axis=-1).reshape(-1, 2)
    return grid[shapely.contains_xy(region, grid)]
