"""A map in another frame: turned about the vertical and shifted, with all its covariances."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.core.gaussian import pack, symmetric_sqrt, unpack
from bsmap_cli.merge.surveys import Sum, moved_centre, with_common_modes
from bsmap_cli.model import (
    Array,
    BSplineSurface,
    HeightCovariance,
    Placement,
    PosePart,
    SurfaceCovariance,
    SurfaceMap,
)


def placed(surface_map: SurfaceMap, placement: Placement) -> SurfaceMap:
    """The map where the placement lays it; the error of the placement is one that all its data sets have in common."""
    parts = {part.data_set: part for surface in surface_map.surfaces for part in surface.covariance.pose}
    poses = with_common_modes({name: _placed_part(parts[name], placement) for name in sorted(parts)})
    creases = tuple(replace(crease, points=_points(crease.points, placement)) for crease in surface_map.creases)
    return replace(
        surface_map,
        surfaces=tuple(_surface(surface, placement, poses) for surface in surface_map.surfaces),
        creases=creases,
        corners=_points(surface_map.corners, placement),
    )


def _points(points: Array, placement: Placement) -> Array:
    """(..., 3) in the new frame."""
    xy = se2.transform(placement.pose, points[..., :2])
    return np.concatenate([xy, points[..., 2:] + placement.height], axis=-1)


def _turn(placement: Placement) -> Array:
    """(3, 3) of vectors in space, and of x, y, theta as well."""
    c, s = np.cos(placement.pose[2]), np.sin(placement.pose[2])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _placed_part(part: PosePart, placement: Placement) -> Sum:
    R, centre = _turn(placement), se2.transform(placement.pose, part.centre)
    by_placement = moved_centre(centre - placement.pose[:2]) @ symmetric_sqrt(placement.covariance)
    modes = {} if part.modes is None else {part.trajectory: R @ part.modes}
    modes[f"placed-{placement.survey}"] = by_placement
    covariance = R @ part.covariance @ R.T + by_placement @ by_placement.T
    return Sum(replace(part, centre=centre, covariance=covariance, modes=None), modes)


def _surface(surface: BSplineSurface, placement: Placement, poses: Mapping[str, PosePart]) -> BSplineSurface:
    pose = tuple(replace(poses[part.data_set], weight=part.weight) for part in surface.covariance.pose)
    return replace(
        surface,
        control_points=_points(surface.control_points, placement),
        covariance=replace(_turned(surface.covariance, _turn(placement)), pose=pose),
    )


def _turned(covariance: SurfaceCovariance | HeightCovariance, R: Array) -> SurfaceCovariance | HeightCovariance:
    if isinstance(covariance, HeightCovariance):
        return replace(covariance, directions=covariance.directions @ R.T)
    return replace(covariance, blocks=pack(R @ unpack(covariance.blocks) @ R.T))
