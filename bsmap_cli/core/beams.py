"""Beams of a cloud: where they begin, and where they meet a surface."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.basis import Surface
from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.model import Array, IntArray, PointCloud

STEPS = 8
"""Of Newton; from a foot nearby a flat surface takes one or two."""
MET = 1e-6
"""Metres between surface and beam at which they have met."""
CHUNK = 8192
"""Beams whose begins are computed at a time: they fit into the processor's cache."""


class Meetings(NamedTuple):
    """Where beams meet a surface: parameters u, v (n,), lengths (n,) of the beams up to there, metres; nan: nowhere."""

    u: Array
    v: Array
    length: Array


def beam_origins(cloud: PointCloud, index: IntArray | NDArray[np.intp]) -> Array:
    """(k, 3) begin in map of the beams of points `index` (k,): the laser's place at the time of the beam."""
    by_time = np.argsort(cloud.scan_time_ns, kind="stable")
    time, poses = cloud.scan_time_ns[by_time], cloud.scan_poses[by_time]
    origins = np.full((len(index), 3), cloud.mount[2, 3])
    for first in range(0, len(index), CHUNK):
        part = slice(first, first + CHUNK)
        at = se2.interpolate(time, poses, cloud.time_ns[index[part]])
        origins[part, :2] = se2.transform(at, cloud.mount[:2, 3])
    return origins


def cross(surface: Surface, origins: Array, directions: Array, u: Array, v: Array) -> Meetings:
    """Where beams meet a surface, by Newton on S(u, v) - origin - t direction = 0.

    Parameters
    ----------
    origins, directions : (n, 3), directions of length 1.  u, v : (n,) starts, such as the feet of the beams' ends.
    """
    uv, t = np.stack([u, v], axis=-1), np.full(len(u), np.nan)
    gap = np.full(len(u), np.inf)
    for _ in range(STEPS):
        S, Su, Sv = evaluate_surface(surface, uv[:, 0], uv[:, 1], 1)
        beside = S - origins
        t = np.einsum("nk,nk->n", beside, directions)
        gap = np.linalg.norm(beside - t[:, None] * directions, axis=1)
        if not (gap > MET).any():
            break
        M = np.stack([Su, Sv, -directions], axis=-1)
        known = np.abs(np.linalg.det(M)) > 1e-12
        M[~known] = np.eye(3)
        step = np.linalg.solve(M, (t[:, None] * directions - beside)[..., None])[:, :2, 0]
        uv = np.clip(uv + np.where(known[:, None], step, 0.0), 0.0, 1.0)
    return Meetings(uv[:, 0], uv[:, 1], np.where(gap <= MET, t, np.nan))
