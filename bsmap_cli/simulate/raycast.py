"""Distances along rays to a triangle mesh."""

from typing import Any

import numpy as np

from bsmap_cli import open3d_loader
from bsmap_cli.model import Array
from bsmap_cli.simulate.geometry import Mesh

NO_HIT = np.iinfo(np.uint32).max


class Caster:
    """Mesh made ready for ray casting; `distances(origins, directions)` may be called any number of times.

    Open3D casts in float32 and is asked only which triangle a ray hits; the distance is then had in float64 from the
    triangle's plane.
    """

    def __init__(self, mesh: Mesh) -> None:
        self._open3d: Any = open3d_loader.load()
        self._centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
        corners = (mesh.vertices - self._centre)[mesh.triangles]
        self._points = corners[:, 0]
        self._normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        self._scene = self._open3d.t.geometry.RaycastingScene()
        self._scene.add_triangles((mesh.vertices - self._centre).astype(np.float32), mesh.triangles.astype(np.uint32))

    def distances(self, origins: Array, directions: Array) -> Array:
        """Metres (...,) from origins (..., 3) along unit directions (..., 3); inf where nothing is hit."""
        origins = origins - self._centre
        rays = np.concatenate([origins, directions], axis=-1).astype(np.float32)
        cast = self._scene.cast_rays(self._open3d.core.Tensor(rays))
        triangle = cast["primitive_ids"].numpy()
        hit = triangle != NO_HIT
        point, normal = self._points[triangle[hit]], self._normals[triangle[hit]]
        out = np.full(hit.shape, np.inf)
        towards = np.sum(directions[hit] * normal, axis=-1)
        along = np.sum((point - origins[hit]) * normal, axis=-1)
        # A ray that lies in the triangle's plane keeps the distance in float32.
        edge_on = np.abs(towards) < 1e-6 * np.linalg.norm(normal, axis=-1)
        rough = cast["t_hit"].numpy()[hit]
        out[hit] = np.where(edge_on, rough, along / np.where(edge_on, 1.0, towards))
        return out
