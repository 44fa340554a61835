"""The triangles' front is turned to the side from which a surface was seen."""

from collections.abc import Iterable, Mapping

import numpy as np

from bsmap_cli.export.tessellation import Mesh
from bsmap_cli.model import Array, BSplineSurface, PosePart, SurfaceMap

UNDECIDED = 1e-3
"""Share of a surface's solid angle seen from one side, below which neither side counts as the sensor's."""


def viewpoints(surface_map: SurfaceMap) -> dict[str, Array]:
    """Data set -> point (3,) in map from which it was seen, about: its centre, halfway between its floor and ceiling.

    The map does not tell how high the laser stood. Halfway is on the right side of floor and ceiling, and walls do not
    care; only something flat between that height and the laser's (the top of a tall cupboard) is turned wrongly.
    """
    names = sorted({part.data_set for surface in surface_map.surfaces for part in surface.covariance.pose})
    return {name: _viewpoint(name, surface_map.surfaces) for name in names}


def _viewpoint(data_set: str, surfaces: Iterable[BSplineSurface]) -> Array:
    seen = [(s, part) for s in surfaces for part in s.covariance.pose if part.data_set == data_set]
    heights = np.concatenate([s.control_points[:, :, 2].ravel() for s, _ in seen])
    return np.append(seen[0][1].centre, (heights.min() + heights.max()) / 2.0)


def turned(mesh: Mesh, surface: BSplineSurface, seen_from: Mapping[str, Array]) -> Mesh:
    """Mesh of a surface, its front to the side from which that was seen; by `turn_to_sensor` where it does not tell."""
    if surface.side == 0:
        return turn_to_sensor(mesh, surface.covariance.pose, seen_from)
    return _reversed(mesh) if surface.side < 0 else mesh


def turn_to_sensor(mesh: Mesh, parts: Iterable[PosePart], seen_from: Mapping[str, Array]) -> Mesh:
    """The mesh, reversed where its data sets, by their weights, saw its back; as it is where that is undecided."""
    front = sum(part.weight * frontness(mesh, seen_from[part.data_set]) for part in parts)
    return _reversed(mesh) if front < -UNDECIDED else mesh


def _reversed(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, mesh.triangles[:, ::-1])


def frontness(mesh: Mesh, viewpoint: Array) -> float:
    """Share in [-1, 1] of the mesh's solid angle that turns its front (1) or its back (-1) to a point (3,).

    Each triangle's solid angle is taken as A n . d / |d|^3, d from its middle to the point: sums, not angles, matter.
    """
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    to_point = viewpoint - (a + b + c) / 3.0
    distance = np.maximum(np.linalg.norm(to_point, axis=1), 1e-6)
    angle = np.einsum("nd,nd->n", np.cross(b - a, c - a), to_point) / distance**3
    total = float(np.abs(angle).sum())
    return float(angle.sum()) / total if total > 0.0 else 0.0
