"""The simulated robot: two lasers, and odometry that drifts as that of a differential drive does."""

from dataclasses import dataclass

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import Array
from bsmap_cli.simulate.path import Path, poses_at

FIELD_OF_VIEW = 1.5 * np.pi
RANGE_MIN, RANGE_MAX = 0.05, 30.0
SCAN_TIME = 0.025  # s, from the first to the last beam of a scan in continuous motion

WHEEL_BASE = 0.4  # m
ODOMETRY_RATE = 20.0  # Hz
# Standard deviations at odometry_error = 1: 1% of the distance, about 1.5 degrees a full turn, 0.03 rad in 100 m.
SCALE_SIGMA = 0.01  # of both wheels' radius
WHEEL_DIFFERENCE_SIGMA = 0.0002  # of one wheel's radius against the other's
WHEEL_BASE_SIGMA = 0.004
STEP_SIGMA = 0.001  # m at a wheel in the square root of a metre


@dataclass(frozen=True)
class Laser:
    """A laser range finder: name of its frame, number of beams over 270 degrees, mount (4, 4) T_base_laser.

    delay : s, of its scans after the period's begin in continuous motion.
    """

    name: str
    beams: int
    mount: Array
    delay: float

    # Rounded to what the float32 fields of a LaserScan message hold, so that a log can be read back unchanged.
    @property
    def angle_min(self) -> float:
        return float(np.float32(-FIELD_OF_VIEW / 2))

    @property
    def angle_increment(self) -> float:
        return float(np.float32(FIELD_OF_VIEW / (self.beams - 1)))

    @property
    def angles(self) -> Array:
        """(beams,) radians in the laser's frame."""
        return self.angle_min + self.angle_increment * np.arange(self.beams, dtype=np.float64)


def _mount(x: float, z: float, x_axis: tuple[float, ...], y_axis: tuple[float, ...]) -> Array:
    mount = np.eye(4)
    mount[:3, :3] = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
    mount[:3, 3] = x, 0.0, z
    return mount


HORIZONTAL = Laser("laser_horizontal", 760, _mount(0.1, 0.35, (1, 0, 0), (0, 1, 0)), 0.0)
VERTICAL = Laser("laser_vertical", 541, _mount(-0.05, 0.6, (0, 0, 1), (0, 1, 0)), 0.037)


def odometry(path: Path, time: Array, error: float, rng: np.random.Generator) -> Array:
    """Poses (n, 3) in the odometry frame, which is the true pose at time[0], from the increments of two wheels.

    time : (n,) s, ascending.  error : scale of all errors; 0 gives the true motion.
    Systematic errors (wheels' radii, wheel base) are drawn once; random ones grow with the square root of the way.
    """
    scale = 1 + error * (SCALE_SIGMA * rng.standard_normal() + WHEEL_DIFFERENCE_SIGMA * rng.standard_normal(2) / 2**0.5)
    # Robots are calibrated by turning on the spot, which finds the wheel base as a multiple of the assumed radius.
    wheel_base = WHEEL_BASE * scale.mean() * (1 + error * WHEEL_BASE_SIGMA * rng.standard_normal())
    # Steps end where the motion changes too: within each, both wheels turn evenly and the arc is exact.
    inside = path.time[(path.time > time[0]) & (path.time < time[-1])]
    t = np.union1d(time, inside)
    twists = _twists_at(path, (t[:-1] + t[1:]) / 2)
    wheels = np.diff(t)[:, None] * (twists[:, :1] + twists[:, 1:] * WHEEL_BASE / 2 * np.array([-1.0, 1.0]))
    noise = error * STEP_SIGMA * np.sqrt(np.abs(wheels)) * rng.standard_normal(wheels.shape)
    left, right = (wheels * scale + noise).T
    measured = integrate_wheels(left, right, wheel_base)
    return measured[np.searchsorted(t, time)]


def integrate_wheels(left: Array, right: Array, wheel_base: float) -> Array:
    """Poses (n + 1, 3) from the origin by increments (n,) m of the two wheels."""
    way, turn = (left + right) / 2, (right - left) / wheel_base
    theta = np.concatenate([[0.0], np.cumsum(turn)])
    heading, chord = theta[:-1] + turn / 2, way * np.sinc(turn / 2 / np.pi)
    steps = np.column_stack([chord * np.cos(heading), chord * np.sin(heading)])
    xy = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return np.column_stack([xy, se2.wrap(theta)])


def _twists_at(path: Path, time: Array) -> Array:
    """Speeds and turning rates (n, 2) at times (n,) s; at rest outside the path."""
    i = np.searchsorted(path.time, time, side="right") - 1
    inside = (i >= 0) & (i < len(path.twists))
    return np.where(inside[:, None], path.twists[np.clip(i, 0, len(path.twists) - 1)], 0.0)


def beam_rays(laser: Laser, path: Path, time: Array) -> tuple[Array, Array]:
    """Origins and unit directions (n, m, 3) in the scene frame of beams sent out at times (n, m) s."""
    x, y, theta = poses_at(path, time.ravel()).T
    angles = np.broadcast_to(laser.angles, time.shape).ravel()
    d = np.cos(angles)[:, None] * laser.mount[:3, 0] + np.sin(angles)[:, None] * laser.mount[:3, 1]
    o = laser.mount[:3, 3]
    c, s = np.cos(theta), np.sin(theta)
    origins = np.column_stack([x + c * o[0] - s * o[1], y + s * o[0] + c * o[1], np.full(len(x), o[2])])
    directions = np.column_stack([c * d[:, 0] - s * d[:, 1], s * d[:, 0] + c * d[:, 1], d[:, 2]])
    return origins.reshape(*time.shape, 3), directions.reshape(*time.shape, 3)
