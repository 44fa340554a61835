"""The filter's motion prior: odometry or constant velocity, with noise; the motion within one scan."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import Array, ScanLog
from bsmap_cli.params import SlamParams

MAX_SPEED = 3.0
MAX_TURN_RATE = 3.0
"""m/s and rad/s; a faster indoor robot is a jump of the odometry or a gap in the stamps."""


class Motion(NamedTuple):
    """increment : (3,) x, y, theta in the robot's frame.  noise : (3, 3), its covariance."""

    increment: Array
    noise: Array


def odometry_motion(before: Array, after: Array, params: SlamParams) -> Motion:
    """Motion between two poses of the odometry; its error grows with distance and angle, method.md section 2."""
    increment = se2.between(before, after)
    distance, angle = float(np.hypot(*increment[:2])), abs(float(increment[2]))
    place = params.odometry_translation * distance + params.odometry_coupling * angle
    heading = params.odometry_rotation * angle + params.odometry_coupling * distance
    return Motion(increment, np.diag([place, place, heading]) ** 2)


def constant_velocity(last: Array, last_seconds: float, seconds: float, params: SlamParams) -> Motion:
    """Motion by the velocity of the step before; its error is a change of that velocity.

    last : (3,) increment of the step before, which took `last_seconds`.
    """
    ratio = min(seconds / last_seconds, 2.0) if last_seconds > 0 else 0.0
    # A second of unknown motion is as bad as it gets: a match must still be possible.
    spread = min(params.acceleration * seconds * max(seconds, 0.1), 0.15)
    return Motion(last * ratio, np.diag([spread, spread, spread]) ** 2)


def beam_motion(log: ScanLog) -> Array:
    """(n, 3) motion of base_link from one beam of a horizontal scan to the next, by the odometry; else 0."""
    scans = log.horizontal
    n = len(scans.time_ns)
    if log.odometry is None or scans.time_increment == 0.0 or n < 2:
        return np.zeros((n, 3))
    seconds = np.diff(scans.time_ns) * 1e-9
    step = se2.between(log.odometry[:-1], log.odometry[1:])
    with np.errstate(divide="ignore", invalid="ignore"):
        velocity = step / seconds[:, None]
    sane = (seconds > 0) & (np.hypot(*velocity[:, :2].T) < MAX_SPEED) & (np.abs(velocity[:, 2]) < MAX_TURN_RATE)
    velocity[~sane] = 0.0
    return np.r_[velocity, velocity[-1:]] * scans.time_increment
