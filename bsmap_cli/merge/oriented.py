"""Samples of a map with normals towards the sensor: what registration looks at, whatever the surfaces are made of."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bsmap_cli.core import se2
from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.trims import inside_trims
from bsmap_cli.merge.facing import SENSOR_HEIGHT, sensor_position
from bsmap_cli.model import Array, BSplineSurface, IntArray, SurfaceMap

STEP, MOST = 0.1, 600
"""Metres between samples, and the most of them each way of a surface."""
STEEP, LEVEL = 0.5, 0.9
"""Vertical part of a normal below which a surface counts as a wall, and above which as level."""
TURNED = 0.5
"""Metres that two samples count as apart for each radian between their normals: both sides of a thin wall are far."""
AROUND, OF_GRID = 1.5 * STEP, 9
"""Metres, and how many samples of a single surface lie no farther than that from one of them, itself among them."""


class Oriented(NamedTuple):
    """points : (n, 3) metres in map.  normals : (n, 3) unit, towards the sensor.

    areas : (n,) square metres each stands for; where several surfaces lie on each other, all together for one.
    """

    points: Array
    normals: Array
    areas: Array

    @property
    def steep(self) -> NDArray[np.bool_]:
        """(n,) which lie on walls."""
        return np.asarray(np.abs(self.normals[:, 2]) < STEEP)

    @property
    def floor(self) -> NDArray[np.bool_]:
        """(n,) which lie on what a robot can stand on."""
        z = self.points[:, 2]
        return np.asarray((self.normals[:, 2] > LEVEL) & (z < z.min(initial=np.inf) + SENSOR_HEIGHT))

    def of(self, some: Array | IntArray | NDArray[np.bool_]) -> "Oriented":
        """Those of an index or a mask."""
        return Oriented(self.points[some], self.normals[some], self.areas[some])

    def moved(self, pose: Array, height: float) -> "Oriented":
        """In the frame in which the planar pose (3,) and the height of theirs are given."""
        turn = pose * np.array([0.0, 0.0, 1.0])
        points = np.column_stack([se2.transform(pose, self.points[:, :2]), self.points[:, 2] + height])
        normals = np.column_stack([se2.transform(turn, self.normals[:, :2]), self.normals[:, 2]])
        return self._replace(points=points, normals=normals)

    def keys(self) -> Array:
        """(n, 6) places among which those near each other lie near and look the same way."""
        return np.column_stack([self.points, TURNED * self.normals])


def oriented_samples(surface_map: SurfaceMap) -> Oriented:
    """Samples of all surfaces of a map."""
    parts = [_samples(surface) for surface in surface_map.surfaces]
    none = np.zeros((0, 3))
    return with_areas(np.concatenate([none, *(p for p, _ in parts)]), np.concatenate([none, *(n for _, n in parts)]))


def with_areas(points: Array, normals: Array) -> Oriented:
    """Samples of a grid of STEP on one surface or several: what lies on each other shares the area of the place."""
    found = Oriented(points, normals, np.full(len(points), STEP**2))
    if not len(points):
        return found
    keys = found.keys()
    around = cKDTree(keys).query_ball_point(keys, AROUND, return_length=True)
    return found._replace(areas=STEP**2 * np.minimum(1.0, OF_GRID / around))


def _samples(surface: BSplineSurface) -> tuple[Array, Array]:
    """Points and unit normals (n, 3) on a grid, inside the trims."""
    P = surface.control_points
    lengths = [np.linalg.norm(np.diff(P, axis=k), axis=2).sum(axis=k).max() for k in (0, 1)]
    counts = [int(np.clip(np.ceil(length / STEP), 1, MOST)) for length in lengths]
    u, v = ((np.arange(count) + 0.5) / count for count in counts)
    at = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    at = at[inside_trims(surface, at)]
    points, Su, Sv = evaluate_surface(surface, at[:, 0], at[:, 1], 1)
    normals = np.cross(Su, Sv)
    size = np.linalg.norm(normals, axis=1)
    by_centre = np.sign(np.sum((sensor_position(surface) - points) * normals, axis=1))
    sides = np.full(len(points), float(surface.side)) if surface.side else by_centre
    good = (size > 0.0) & (sides != 0.0)
    return points[good], (sides[good] / size[good])[:, None] * normals[good]
