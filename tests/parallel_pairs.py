"""Parallel faces that lie close together in the scenes `walls` and `steps`, and how a map shows them."""

from typing import NamedTuple

import numpy as np

from bsmap_cli import open3d_loader
from bsmap_cli.evaluate import transform_points
from bsmap_cli.export.tessellation import tessellate

STEP = 0.05
"""Metres between places at which a side is looked at."""
SHARE = 0.05
"""Of a side's places, from which on a surface counts as lying there."""


class Side(NamedTuple):
    """Rectangle on a plane of the scene that the vertical laser sees, metres.

    axis : of its normal.  level : coordinate along it.  looks : +1 or -1, to which side it is free.
    low, high : (2,) of the other two coordinates, in their order.
    """

    axis: int
    level: float
    looks: int
    low: tuple[float, float]
    high: tuple[float, float]

    def places(self):
        """(n, 3) over the rectangle, and its normal (3,)."""
        grid = np.stack(np.meshgrid(*map(np.arange, self.low, self.high, (STEP, STEP)), indexing="ij"), axis=-1)
        points = np.insert(grid.reshape(-1, 2), self.axis, self.level, axis=1)
        return points, self.looks * np.eye(3)[self.axis]


class Pair(NamedTuple):
    """Two sides."""

    name: str
    first: Side
    second: Side

    @property
    def apart(self):
        """Metres."""
        return abs(self.first.level - self.second.level)


PAIRS = {
    "walls": [
        Pair("wall of 5 cm", Side(1, 2.4, -1, (1.2, 0.1), (4.6, 2.5)), Side(1, 2.45, 1, (1.2, 0.1), (4.6, 2.5))),
        Pair("wall of 10 cm", Side(1, 4.85, -1, (2.3, 0.9), (5.2, 2.5)), Side(1, 4.95, 1, (2.3, 0.1), (5.2, 2.7))),
        Pair("wall of 20 cm", Side(1, 7.35, -1, (1.6, 0.1), (4.6, 2.7)), Side(1, 7.55, 1, (1.6, 0.1), (4.6, 2.5))),
        Pair("leaf, 9 cm", Side(0, 6.1, -1, (2.55, 0.1), (3.7, 1.95)), Side(0, 6.19, -1, (3.85, 0.1), (4.6, 2.5))),
    ],
    "steps": [
        Pair("half panel, 4 cm", Side(1, 0.0, 1, (2.2, 0.1), (3.35, 2.7)), Side(1, 0.04, 1, (3.45, 0.1), (4.8, 2.7))),
        Pair("panel, 4 cm", Side(0, 6.96, -1, (2.25, 0.1), (3.75, 2.0)), Side(0, 7.0, -1, (2.25, 2.15), (3.75, 2.7))),
        Pair("platform, 4 cm", Side(2, 0.0, 1, (2.3, 1.2), (4.7, 2.2)), Side(2, 0.04, 1, (2.6, 2.4), (4.4, 3.6))),
        Pair("leaf, 10 cm", Side(1, 5.9, -1, (2.65, 0.1), (3.55, 1.95)), Side(1, 6.0, -1, (3.65, 0.1), (4.8, 2.7))),
    ],
}


class Shown(NamedTuple):
    """How a map shows a pair.

    found : of both sides, the lesser share of the places where a surface lies nearer than half of what they are apart
    (at most 3 cm).  layers : of both, the greater mean number of surfaces there.  shared : surfaces that lie on both.
    apart : metres between both, by the medians of the heights of all surfaces.
    """

    found: float
    layers: float
    shared: int
    apart: float

    @property
    def told(self):
        """Whether both sides are there, and no surface lies on both."""
        return self.found > 0.9 and self.shared == 0


def heights_on(side, scenes, reach):
    """(surfaces, places) metres of each surface above the side, NaN where it does not lie within `reach`."""
    o3d = open3d_loader.load()
    points, normal = side.places()
    rays = np.hstack([points + reach * normal, np.tile(-normal, (len(points), 1))]).astype(np.float32)
    ways = np.array([scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() for scene in scenes])
    return np.where(ways < 2 * reach, reach - ways, np.nan)


def shown(pair, surface_map, pose):
    """How a map shows a pair; pose (3,) of map in the scene."""
    o3d = open3d_loader.load()
    scenes = []
    for surface in surface_map.surfaces:
        mesh = tessellate(surface, 0.001)
        if len(mesh.triangles):
            scene = o3d.t.geometry.RaycastingScene()
            vertices = transform_points(pose, mesh.vertices)
            scene.add_triangles(vertices.astype(np.float32), mesh.triangles.astype(np.uint32))
            scenes.append(scene)
    reach = min(pair.apart / 2, 0.03)
    both = [heights_on(side, scenes, reach) for side in (pair.first, pair.second)]
    layers = [np.isfinite(h).sum(axis=0) for h in both]
    there = [np.isfinite(h).mean(axis=1) > SHARE for h in both]
    levels = [
        side.level + side.looks * np.nanmedian(h) if np.isfinite(h).any() else np.nan
        for side, h in zip((pair.first, pair.second), both, strict=True)
    ]
    return Shown(
        float(min((n > 0).mean() for n in layers)),
        float(max(n.mean() for n in layers)),
        int(np.count_nonzero(there[0] & there[1])),
        float(abs(levels[1] - levels[0])),
    )
