"""Faces over planes as merging needs them: their height field, what of it is there, and samples on it."""

from typing import NamedTuple

import numpy as np
import shapely

from bsmap_cli.core.uncertainty import pose_covariance, pose_difference
from bsmap_cli.fit.heights import HeightField, Knots, PlaneBase, basis_matrix, evaluate
from bsmap_cli.merge.facing import sensor_position
from bsmap_cli.merge.regions import Region, region_of
from bsmap_cli.model import Array, BSplineSurface, HeightCovariance

SAMPLES = 150
"""About so many on a face, but not closer than CLOSEST nor farther apart than FARTHEST, metres."""
CLOSEST, FARTHEST = 0.03, 0.3
LEAST_HEIGHT = 0.3
"""Metres off the plane at which a data set's centre tells the side from which it saw a wall."""


class PlanarFace(NamedTuple):
    """A trimmed surface over a plane.

    region : in s and t of the field's base, metres.  facing : +1 or -1 where the base's normal points to the sensor or
    away, 0 where the centre of the data set does not tell.
    samples : (n, 3) in map, those of the border last.  areas : (n,) square metres each stands for, 0 at the border.
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
    def normal(self) -> Array:
        """(3,) unit normal of the base in map."""
        return np.asarray(self.field.base.axes[:, 2])  # type: ignore[union-attr]

    @property
    def area(self) -> float:
        """Square metres."""
        return float(self.region.area)


def is_planar(surface: BSplineSurface) -> bool:
    """Whether a surface is a trimmed height field over a plane."""
    covariance = surface.covariance
    return (
        bool(surface.trims) and isinstance(covariance, HeightCovariance) and covariance.directions.shape[:2] == (1, 1)
    )


def planar_face(surface: BSplineSurface) -> PlanarFace | None:
    """The face of a surface for which `is_planar` holds; None where nothing of it is left inside its trims."""
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
    areas = np.concatenate([np.full(len(inner), region.area / max(len(inner), 1)), np.zeros(len(border))])
    variances = height_variances(surface, field, uv)
    off = float((sensor_position(surface) - samples.mean(axis=0)) @ field.base.axes[:, 2])  # type: ignore[union-attr]
    facing = 0 if abs(off) < LEAST_HEIGHT else int(np.sign(off))
    return PlanarFace(surface, field, region, facing, samples, areas, variances)


def field_of(surface: BSplineSurface) -> HeightField:
    """Height field of a surface over a plane; its base has its origin at the first control point."""
    covariance = surface.covariance
    assert isinstance(covariance, HeightCovariance)
    n = covariance.directions[0, 0] / np.linalg.norm(covariance.directions[0, 0])
    P = surface.control_points
    s = _across(P[-1, 0] - P[0, 0], n)
    t = _across(P[0, -1] - P[0, 0], n)
    t = _across(t - (t @ s) * s, n)
    base = PlaneBase(P[0, 0], np.column_stack([s, t, n]))
    local = base.local(P)
    knots = Knots(surface.degree_u, surface.degree_v, surface.knots_u, surface.knots_v)
    return HeightField(base, np.zeros(2), local[-1, -1, :2], knots, local[..., 2])


def height_variances(surface: BSplineSurface, field: HeightField, uv: Array) -> Array:
    """(n,) sensor part of the heights' variances at parameters (n, 2), those outside as at the nearest inside."""
    assert isinstance(surface.covariance, HeightCovariance)
    N = basis_matrix(field.knots, uv)
    return np.asarray(np.maximum(np.einsum("ni,ij,nj->n", N, surface.covariance.matrix, N), 0.0))


def pose_variances(face: PlanarFace, other: PlanarFace, points: Array) -> Array:
    """(n,) variance across the plane of `face` that the poses of both give the difference of their points there."""
    both = pose_difference(face.surface.covariance.pose, other.surface.covariance.pose)
    n = face.normal
    return np.asarray(np.einsum("i,nij,j->n", n, pose_covariance(both, points), n))


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
