"""Surfaces of known shape, place and covariance for the tests of merging."""

import numpy as np

from bsmap_cli.core.bspline import clamped_knots
from bsmap_cli.core.gaussian import pack
from bsmap_cli.model import Array, BSplineSurface, DataSet, PosePart, Residuals, SurfaceCovariance, SurfaceMap


def greville(knots: Array, degree: int) -> Array:
    """Parameters at which the control points of the identity lie."""
    return np.array([knots[i + 1 : i + 1 + degree].mean() for i in range(len(knots) - degree - 1)])


def plane(
    name: str,
    corner,
    along_u,
    along_v,
    centre=(0.0, 0.0),
    sigma: float = 0.003,
    pose_sigma: float = 0.01,
    rms: float = 0.005,
    inner: int = 3,
) -> BSplineSurface:
    """Bicubic surface over the parallelogram corner + u along_u + v along_v, seen from near `centre`."""
    knots = clamped_knots(3, np.linspace(0, 1, inner + 2)[1:-1])
    g = greville(knots, 3)
    u, v = np.asarray(along_u, dtype=float), np.asarray(along_v, dtype=float)
    points = np.asarray(corner, dtype=float) + g[:, None, None] * u + g[None, :, None] * v
    n = len(g)
    near = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    blocks = np.broadcast_to(pack(np.eye(3) * sigma**2), (n, n, 6)).copy()
    pose = PosePart(name, np.asarray(centre, dtype=float), np.diag([pose_sigma**2, pose_sigma**2, 1e-6]))
    covariance = SurfaceCovariance(blocks, 0.5**near, 0.4**near, (pose,))
    residuals = Residuals(1000, rms * 0.8, rms, 2 * rms, 3 * rms)
    return BSplineSurface(name, (name,), 3, 3, knots, knots, points, covariance, residuals)


def map_of(*surfaces: BSplineSurface) -> SurfaceMap:
    """Map of surfaces, each from its own data set."""
    data_sets = tuple(DataSet(s.name, "translation", 0, 9, s.residuals.points) for s in surfaces)
    return SurfaceMap(surfaces, data_sets)


def wall(name: str, x0: float, x1: float, y: float = 2.0, centre=None, **keywords) -> BSplineSurface:
    """Upright wall, u up and v along x, 2 m high, at the given y; seen from y = 0 unless said."""
    centre = ((x0 + x1) / 2, 0.0) if centre is None else centre
    return plane(name, (x0, y, 0.2), (0, 0, 2.0), (x1 - x0, 0, 0), centre, **keywords)
