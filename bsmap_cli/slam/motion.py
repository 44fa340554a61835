"""The filter's motion prior: odometry or constant velocity, with noise; the motion within one scan."""

import math
from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import Array, LaserScans
from bsmap_cli.params import SlamParams

MAX_SPEED = 3.0
MAX_TURN_RATE = 3.0
"""m/s and rad/s; a faster indoor robot is a jump of the odometry or a gap in the stamps."""


SCALE_SIGMA, STEP_SIGMA = 0.03, 0.01
"""Of the odometry's scale before anything was seen; metres by which a step is off beside the match, for rough walls."""
LEAST_STEP, LARGEST_TURN, SLIP = 0.1, 0.2, 3.0
"""Metres and radians of steps that tell the scale; standard deviations beyond which they do not."""


class Motion(NamedTuple):
    """increment : (3,) x, y, theta in the robot's frame.  noise : (3, 3), its covariance."""

    increment: Array
    noise: Array


def odometry_motion(before: Array, after: Array, params: SlamParams, scale: float = 1.0) -> Motion:
    """Motion between two poses of the odometry; its error grows with distance and angle, method.md section 2.

    scale : metres of way for a metre of odometry.
    """
    x, y, turn = se2.between(before, after).tolist()
    distance, angle = scale * math.hypot(x, y), abs(turn)
    place = params.odometry_translation * distance + params.odometry_coupling * angle
    heading = params.odometry_rotation * angle + params.odometry_coupling * distance
    noise = np.array([[place**2, 0.0, 0.0], [0.0, place**2, 0.0], [0.0, 0.0, heading**2]])
    return Motion(np.array([scale * x, scale * y, turn]), noise)


class OdometryScale(NamedTuple):
    """How much longer ways are than the odometry tells, as matches show it where they are sure: weights and products.

    Wheels' radii are known to a percent or so. Along a bare corridor, where a match tells little of the way, it is
    drawn to the odometry, and with each step in the same direction: the whole map gets longer or shorter.
    """

    weight: float = SCALE_SIGMA**-2
    product: float = SCALE_SIGMA**-2

    @property
    def value(self) -> float:
        """Metres of way for a metre of odometry."""
        return self.product / self.weight

    def seen(self, told: Array, matched: Array, information: Array) -> "OdometryScale":
        """After a step told by the odometry (3,) and found by a match (3,) with information (3, 3), robot's axes.

        Turns, and steps that disagree beyond what a scale explains (slip, a false match), say nothing.
        """
        way = float(np.hypot(told[0], told[1]))
        if way < LEAST_STEP or abs(told[2]) > LARGEST_TURN:
            return self
        ahead = told[:2] / way
        spread = 1.0 / max(float(ahead @ information[:2, :2] @ ahead), 1e-9) + STEP_SIGMA**2
        along = float(ahead @ matched[:2])
        if (along - self.value * way) ** 2 > SLIP**2 * (spread + (SCALE_SIGMA * way) ** 2):
            return self
        return OdometryScale(self.weight + way**2 / spread, self.product + way * along / spread)


def constant_velocity(last: Array, last_seconds: float, seconds: float, params: SlamParams) -> Motion:
    """Motion by the velocity of the step before; its error is a change of that velocity.

    last : (3,) increment of the step before, which took `last_seconds`.
    """
    ratio = min(seconds / last_seconds, 2.0) if last_seconds > 0 else 0.0
    # A second of unknown motion is as bad as it gets: a match must still be possible.
    spread = min(params.acceleration * seconds * max(seconds, 0.1), 0.15)
    return Motion(last * ratio, np.diag([spread, spread, spread]) ** 2)


def beam_motion(scans: LaserScans, poses: Array | None) -> Array:
    """(n, 3) motion of base_link from one beam of a horizontal scan to the next, by the `poses` (n, 3); else 0."""
    n = len(scans.time_ns)
    if poses is None or scans.time_increment == 0.0 or n < 2:
        return np.zeros((n, 3))
    seconds = np.diff(scans.time_ns) * 1e-9
    step = se2.between(poses[:-1], poses[1:])
    with np.errstate(divide="ignore", invalid="ignore"):
        velocity = step / seconds[:, None]
    sane = (seconds > 0) & (np.hypot(*velocity[:, :2].T) < MAX_SPEED) & (np.abs(velocity[:, 2]) < MAX_TURN_RATE)
    velocity[~sane] = 0.0
    return np.r_[velocity, velocity[-1:]] * scans.time_increment
