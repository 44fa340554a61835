"""Ways of a differential-drive robot: piecewise constant speed and turning rate, so that every pose is exact."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import Array

RAMP_TIME = 0.6  # s, for the turning rate to grow from nothing to its full value
ACCELERATION = 0.5  # m/s^2
PIECE_TIME = 0.005  # s, of constant speed within a ramp
STAND_TIME = 0.5  # s, before the first and after the last movement


class Path(NamedTuple):
    """Poses of base_link in the scene frame over time.

    time : (k,) s, ascending from 0.  poses : (k, 3) x, y, theta at these times, theta not wrapped.
    twists : (k - 1, 2) speed (m/s) and turning rate (rad/s) from one time to the next.
    """

    time: Array
    poses: Array
    twists: Array


def integrate(start: Sequence[float], durations: Array, twists: Array) -> Path:
    """Path from the pose `start` with speeds and turning rates `twists` (n, 2), each for its duration (n,) s."""
    turned = durations * twists[:, 1]
    theta = start[2] + np.concatenate([[0.0], np.cumsum(turned)])
    steps = _chord(theta[:-1], twists, durations)
    xy = np.asarray(start[:2]) + np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    return Path(np.concatenate([[0.0], np.cumsum(durations)]), np.column_stack([xy, theta]), twists)


def poses_at(path: Path, time: Array) -> Array:
    """Poses (n, 3) at times (n,) s, theta wrapped; before the start and after the end the robot stands."""
    t = np.clip(time, path.time[0], path.time[-1])
    i = np.clip(np.searchsorted(path.time, t, side="right") - 1, 0, len(path.twists) - 1)
    dt = t - path.time[i]
    xy = path.poses[i, :2] + _chord(path.poses[i, 2], path.twists[i], dt)
    return np.column_stack([xy, se2.wrap(path.poses[i, 2] + path.twists[i, 1] * dt)])


def _chord(theta: Array, twists: Array, durations: Array) -> Array:
    """Displacement (n, 2) along arcs: an arc's chord points halfway between its first and its last heading."""
    half = 0.5 * twists[:, 1] * durations
    length = twists[:, 0] * durations * np.sinc(half / np.pi)
    return length[:, None] * np.column_stack([np.cos(theta + half), np.sin(theta + half)])


def stepwise(
    start: Sequence[float], steps: Array, move_time: float = 0.4, rest_time: float = 0.2
) -> tuple[Path, Array]:
    """Path that rests after each step (n, 2) of metres and radians, and the times (n + 1,) s amid its rests."""
    twists = np.zeros((2 * len(steps) + 1, 2))
    twists[1::2] = steps / move_time
    durations = np.full(len(twists), rest_time)
    durations[1::2] = move_time
    rests = np.arange(len(steps) + 1, dtype=np.float64)
    return integrate(start, durations, twists), rest_time / 2 + (move_time + rest_time) * rests


def along(waypoints: Array, radius: float, speed: float) -> Path:
    """Path along a polyline (n, 2) without a stop, its corners rounded by smooth arcs; it starts and ends at rest.

    radius : m, of the arcs where the turning rate is full.  speed : m/s.
    Raises ValueError where two arcs, or an arc and the start or end, overlap.
    """
    sides = np.diff(waypoints, axis=0)
    headings = np.arctan2(sides[:, 1], sides[:, 0])
    turns = [_turn(angle, radius, speed) for angle in se2.wrap(np.diff(headings))]
    tangents = np.array([0.0] + [_tangent(*turn) for turn in turns] + [0.0])
    ramp = speed**2 / (2 * ACCELERATION)
    straight = np.hypot(*sides.T) - tangents[:-1] - tangents[1:]
    straight[[0, -1]] -= ramp
    if np.any(straight < 0):
        raise ValueError(f"waypoints too near to each other for arcs of {radius} m: {straight.round(2)} m are left")
    speeding_up, slowing_down = _ramp(speed), (_ramp(speed)[0], _ramp(speed)[1][::-1])
    rest = (np.array([STAND_TIME]), np.zeros((1, 2)))
    parts = [rest, speeding_up]
    for i, length in enumerate(straight):
        parts.append((np.array([length / speed]), np.array([[speed, 0.0]])))
        parts.extend(turns[i : i + 1])
    parts += [slowing_down, rest]
    start = (*waypoints[0], headings[0])
    return integrate(start, np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]))


def _turn(angle: float, radius: float, speed: float) -> tuple[Array, Array]:
    """Durations and twists of a turn at constant speed, its turning rate a trapezoid (a triangle for small angles)."""
    ramp = RAMP_TIME
    rate = min(speed / radius, abs(angle) / ramp)
    total = abs(angle) / rate + ramp
    n = int(np.ceil(total / PIECE_TIME))
    t = (np.arange(n) + 0.5) * total / n
    shape = np.clip(np.minimum(t, total - t) / ramp, 0.0, 1.0)
    rates = angle * shape / (shape.sum() * total / n)
    return np.full(n, total / n), np.column_stack([np.full(n, speed), rates])


def _tangent(durations: Array, twists: Array) -> float:
    """Metres from the beginning of a turn to the corner that it rounds."""
    end = integrate((0.0, 0.0, 0.0), durations, twists).poses[-1]
    return float(np.hypot(end[0], end[1]) / (2 * np.cos(end[2] / 2)))


def _ramp(speed: float) -> tuple[Array, Array]:
    """Durations and twists from rest to full speed."""
    n = int(np.ceil(speed / ACCELERATION / PIECE_TIME))
    speeds = speed * (np.arange(n) + 0.5) / n
    return np.full(n, speed / ACCELERATION / n), np.column_stack([speeds, np.zeros(n)])
