"""A world of walls in the plane and what a laser sees of it: quick logs of known truth for the tests of slam."""

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import LaserScans, ScanLog
from bsmap_cli.slam.matching import OrientedPoints

SIGMA = 0.01
"""Metres, standard deviation of a range."""


def polygon(*corners: tuple[float, float]) -> np.ndarray:
    """Walls (k, 2, 2) from corner to corner and back to the first."""
    points = np.array(corners, float)
    return np.stack([points, np.roll(points, -1, axis=0)], axis=1)


def box(x0: float, y0: float, x1: float, y1: float) -> np.ndarray:
    """The four walls (4, 2, 2) of a box."""
    return polygon((x0, y0), (x1, y0), (x1, y1), (x0, y1))


def room() -> np.ndarray:
    """A room of 8 x 6 metres about the origin with a pilaster, a niche and two boxes, that looks like no other."""
    outline = polygon(
        (-4, -3), (1, -3), (1, -2.6), (1.5, -2.6), (1.5, -3), (4, -3),
        (4, 0.5), (4.4, 0.5), (4.4, 1.5), (4, 1.5), (4, 3), (-4, 3),
    )  # fmt: skip
    return np.concatenate([outline, box(-3.5, 1.8, -2.2, 2.5), box(2.4, -1.7, 2.9, -1.2)])


def ring() -> np.ndarray:
    """A corridor 2 m wide round a block of 14 x 8 m, with niches of many sizes."""
    outline = polygon(
        (-2, -2), (3, -2), (3, -2.5), (4, -2.5), (4, -2), (9, -2), (9, -2.3), (11, -2.3), (11, -2), (16, -2),
        (16, 3), (16.6, 3), (16.6, 4.5), (16, 4.5), (16, 10), (8, 10), (8, 10.4), (6.5, 10.4), (6.5, 10), (-2, 10),
        (-2, 6), (-2.5, 6), (-2.5, 4.8), (-2, 4.8),
    )  # fmt: skip
    block = polygon((0, 0), (5, 0), (5, 0.3), (5.6, 0.3), (5.6, 0), (14, 0), (14, 8), (10, 8), (10, 7.6), (9, 7.6),
                    (9, 8), (0, 8))  # fmt: skip
    return np.concatenate([outline, block])


def cast(walls: np.ndarray, poses: np.ndarray, angles: np.ndarray, reach: float = 25.0) -> np.ndarray:
    """Ranges (n, m) from poses (n, 3) along beams (m,) to the nearest of the walls (k, 2, 2), or (n, k, 2, 2).

    A beam o + d t meets a wall a + (b - a) s where both sides agree; nan where there is none within `reach`.
    """
    walls = np.broadcast_to(walls, (len(poses), *walls.shape[-3:]))
    out = np.full((len(poses), len(angles)), np.inf)
    for k, (pose, its) in enumerate(zip(poses, walls, strict=True)):
        d = np.stack([np.cos(pose[2] + angles), np.sin(pose[2] + angles)], axis=-1)[:, None]
        from_laser, along = its[:, 0] - pose[:2], its[:, 1] - its[:, 0]
        cross = d[..., 0] * along[:, 1] - d[..., 1] * along[:, 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (from_laser[:, 0] * along[:, 1] - from_laser[:, 1] * along[:, 0]) / cross
            s = (from_laser[:, 0] * d[..., 1] - from_laser[:, 1] * d[..., 0]) / cross
        out[k] = np.where((t > 0.05) & (s >= 0) & (s <= 1), t, np.inf).min(axis=1)
    return np.where(out < reach, out, np.nan)


def along(corners: list[tuple[float, float]], step: float, turn: float = 0.1) -> np.ndarray:
    """Poses (n, 3) of a robot that drives from corner to corner in steps of metres, and turns there in radians."""
    points = np.array(corners, float)
    heading = np.unwrap(np.arctan2(*np.diff(points, axis=0).T[::-1]))
    poses = [np.array([*points[0], heading[0]])]
    for k in range(len(points) - 1):
        turns = max(1, int(np.ceil(abs(heading[k] - poses[-1][2]) / turn)))
        if abs(heading[k] - poses[-1][2]) > 1e-9:
            poses += [np.array([*points[k], a]) for a in np.linspace(poses[-1][2], heading[k], turns + 1)[1:]]
        steps = max(1, int(np.ceil(np.hypot(*(points[k + 1] - points[k])) / step)))
        poses += [np.array([*p, heading[k]]) for p in np.linspace(points[k], points[k + 1], steps + 1)[1:]]
    return np.array(poses)


def log_of(
    walls: np.ndarray,
    poses: np.ndarray,
    seed: int = 0,
    *,
    rate: float = 10.0,
    odometry_error: float | None = 0.02,
    beams: int = 360,
    sigma: float = SIGMA,
) -> ScanLog:
    """Log of a robot at poses (n, 3) in the walls, which sees all round.

    odometry_error : standard deviation of each step, as a share of its length and its turn; None: no odometry.
    """
    rng = np.random.default_rng(seed)
    angles = -np.pi + 2 * np.pi / beams * np.arange(beams)
    ranges = cast(walls, poses, angles)
    ranges += sigma * rng.normal(size=ranges.shape)
    times = np.rint(1e9 / rate * np.arange(len(poses))).astype(np.int64)
    scans = LaserScans(
        times, ranges.astype(np.float32), -np.pi, 2 * np.pi / beams, 0.0, 0.05, 25.0, np.eye(4), "laser", "/scan"
    )
    if odometry_error is None:
        return ScanLog(scans, None, None)
    steps = se2.between(poses[:-1], poses[1:])
    size = np.hypot(steps[:, 0], steps[:, 1])[:, None] * [1, 1, 0.5] + np.abs(steps[:, 2:]) * [0, 0, 1]
    steps += odometry_error * size * rng.normal(size=steps.shape)
    odometry = [np.zeros(3)]
    for step in steps:
        odometry.append(se2.compose(odometry[-1], step))
    return ScanLog(scans, np.array(odometry), None)


def in_first(poses: np.ndarray) -> np.ndarray:
    """Poses (n, 3) in the frame of the first one, which is slam's map."""
    return se2.between(poses[0], poses)


def wall_points(walls: np.ndarray, seen_from: tuple[float, float], spacing: float = 0.05, start: float = 0.5):
    """Points all along the walls with their normals towards a place; `start` shifts them by a share of the spacing."""
    xy, normal = [np.zeros((0, 2))], [np.zeros((0, 2))]
    for a, b in walls:
        length = np.hypot(*(b - a))
        t = (b - a) / length
        at = spacing * (start + np.arange(int(length / spacing)))
        n = np.array([-t[1], t[0]])
        n = n if n @ (np.array(seen_from) - a) > 0 else -n
        xy.append(a + at[:, None] * t)
        normal.append(np.tile(n, (len(at), 1)))
    return OrientedPoints(np.concatenate(xy), np.concatenate(normal))
