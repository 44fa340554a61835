"""Poses of all scans from better ones of some of them and the motion between these."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import Array, IntArray, LaserScans
from bsmap_cli.slam.marginals import Marginals
from bsmap_cli.slam.posegraph import ROBUST_WIDTH, Edges, residuals, robust_means
from bsmap_cli.slam.smoothing import Smoothed
from bsmap_cli.slam.submaps import agree
from bsmap_cli.slam.tracking import MATCH_FLOOR, Tracking

OWN_SHARE, DRIFT_SHARE, FEWEST, STEPS = 0.08, 0.1, 5, 10
"""Of the variances of a step between key scans as matches and as odometry tell it, what these err by where fewer than
FEWEST key scans tell it; of a fixed-point iteration."""


class Between(NamedTuple):
    """poses : (n, 3).  before, after : (n,) which of the known poses lie around each, the last one for those after it.

    share : (n,) of the way from `before` to `after`; 0 where a break lies between these.
    """

    poses: Array
    before: IntArray
    after: IntArray
    share: Array


def between(known: IntArray, poses: Array, motion: Array) -> Between:
    """Poses (n, 3) of all scans: `poses` (k, 3) at the scans `known` (k,), ascending from 0, `motion` (n, 3) else.

    What the motion misses of the way to the next known pose is spread over it, unless it is a break: then all follow
    the one before.
    """
    every = np.arange(len(motion))
    before = np.searchsorted(known, every, side="right") - 1
    after = np.minimum(before + 1, len(known) - 1)
    forward = se2.compose(poses[before], se2.between(motion[known[before]], motion))
    backward = se2.compose(poses[after], se2.between(motion[known[after]], motion))
    span = np.maximum(known[after] - known[before], 1)
    share = np.where((after > before) & agree(forward, backward), (every - known[before]) / span, 0.0)
    miss = backward - forward
    miss[:, 2] = se2.wrap(miss[:, 2])
    found = forward + share[:, None] * miss
    found[:, 2] = se2.wrap(found[:, 2])
    return Between(found, before, after, share)


def evenly(tracking: Tracking, odometry: Array) -> Tracking:
    """With what odometry (n, 3) misses of the way from one match to the next spread over the scans between these."""
    sure = matched(tracking)
    return tracking._replace(poses=between(sure, tracking.poses[sure], odometry).poses)


def every_scan(
    scans: LaserScans, tracking: Tracking, smoothed: Smoothed, known: Marginals, odometry: Edges
) -> tuple[Array, Array, Array]:
    """Poses (n, 3), covariances (n, 3, 3) and modes (n, 3, k) of all scans from those of the key scans.

    Between two key scans the tracked motion is kept. So the error is a share of either key scan's, which are
    correlated, of the match's own, and of the odometry's where a scan was not matched. Key scans err by what is not
    known of the motion within them.

    odometry : from key scan to key scan.
    """
    every, before, after, share = between(tracking.keys, smoothed.poses, tracking.poses)
    first, second = 1.0 - share[:, None, None], share[:, None, None]
    cross = known.following[before] + np.swapaxes(known.following[before], 1, 2)
    spread = first**2 * known.poses[before] + second**2 * known.poses[after] + first * second * cross
    modes = first * known.modes[before] + second * known.modes[after]
    if len(tracking.keys) < 2:
        return every, spread, modes
    step = np.minimum(before, len(tracking.keys) - 2)
    own = in_map(match_covariances(tracking, smoothed.poses)[step], every[:, 2])
    inner = (share > 0) & (share < 1)
    spread[inner] += own[inner]
    spread += swept_covariances(scans, tracking.poses, own)
    if len(odometry.second):
        row = np.searchsorted(odometry.second, step + 1).clip(max=len(odometry.second) - 1)  # a break has none
        drift = in_map(drift_covariances(odometry, smoothed.poses)[row], every[:, 2])
        spread += drift * unmatched(tracking)[:, None, None]
    spread[0] = 0.0
    return every, spread, modes


def within(scans: LaserScans) -> Array:
    """(n,) share of the way to the next scan that is driven until the middle of a scan, at most half of it."""
    duration = scans.time_increment * len(scans.angles)
    seconds = np.diff(scans.time_ns, append=scans.time_ns[-1:]) * 1e-9
    most = 0.5 if duration > 0 else 0.0
    return np.divide(duration / 2, seconds, out=np.full(len(seconds), most), where=seconds > duration)


def swept_covariances(scans: LaserScans, tracked: Array, own: Array) -> Array:
    """(n, 3, 3) in map, of what the mean motion to the next scan leaves unknown of that within a scan.

    The pose of a scan is where the robot was at its first beam; what is matched is known best in its middle.

    tracked : (n, 3) poses.  own : (n, 3, 3) of each one's error, so that of a step is twice as large.
    """
    step = se2.between(tracked[:-1], tracked[1:])
    step = np.concatenate([step, step[-1:]])
    change = np.diff(step, axis=0, prepend=step[:1])  # of a motion that changes between two scans, nobody knows when
    heading = np.concatenate([tracked[:1, 2], tracked[:-1, 2]])
    changed = in_map(change[:, :, None] * change[:, None, :], heading)
    return within(scans)[:, None, None] ** 2 * (2 * own + changed / 3)


def unmatched(tracking: Tracking) -> Array:
    """(n,) share of what odometry misses between two key scans that it misses around a scan that was not matched.

    By scans, as the variance of a random walk between two known ends; after the last of these, with one.
    """
    n, keys = len(tracking.poses), tracking.keys
    sure = matched(tracking)
    every = np.arange(n)
    before = np.searchsorted(sure, every, side="right") - 1
    after = np.minimum(before + 1, len(sure) - 1)
    gone, left = every - sure[before], np.where(after > before, sure[after] - every, np.inf)
    step = np.minimum(np.searchsorted(keys, every, side="right") - 1, len(keys) - 2)
    return gone / (1.0 + gone / left) / (keys[step + 1] - keys[step])


def matched(tracking: Tracking) -> IntArray:
    """(k,) scans that a good match placed, and all key scans."""
    return np.union1d(tracking.keys, np.flatnonzero(tracking.matched))


def match_covariances(tracking: Tracking, poses: Array) -> Array:
    """(k - 1, 3, 3) of how tracked and smoothed place of a scan differ, after each key scan but the last, robot's axes.

    That of a step between key scans, less its allowances for what neighbouring matches have in common, and as large as
    key scans tell: each is placed, once more, by its neighbours and the tracked motion, as if it were no key scan. The
    smoothed place errs too, in part by the same noise.

    poses : (k, 3), smoothed, of the key scans.
    """
    told = _inverse(tracking.edges) - np.diag(MATCH_FLOOR**2)
    rows, miss = left_out(tracking.keys, poses, tracking.poses)
    return _scaled(told, rows - 1, miss, OWN_SHARE)


def drift_covariances(odometry: Edges, poses: Array) -> Array:
    """(m, 3, 3) of the odometry's edges from key scan to key scan, as large as the smoothed poses (k, 3) tell."""
    miss = residuals(poses, odometry)[0]
    return _scaled(_inverse(odometry), np.arange(len(miss)), miss, DRIFT_SHARE)


def _inverse(edges: Edges) -> Array:
    return np.asarray(np.linalg.inv(edges.information), dtype=np.float64)


def _scaled(told: Array, rows: IntArray, miss: Array, prior: float) -> Array:
    """Covariances `told` (k, 3, 3), each axis as large as the errors `miss` (j, 3) in some `rows` (j,) tell."""
    variances = np.maximum(np.diagonal(told, axis1=1, axis2=2), 1e-12)[rows]
    share = np.full(3, prior)
    for _ in range(STEPS if len(rows) >= FEWEST else 0):
        distance = miss**2 / (variances * share)
        share *= np.maximum((distance / (1.0 + distance / ROBUST_WIDTH)).mean(axis=0) / robust_means(1).distance, 0.1)
    return np.asarray(told * np.sqrt(np.outer(share, share)), dtype=np.float64)


def left_out(known: IntArray, poses: Array, motion: Array) -> tuple[IntArray, Array]:
    """Known poses (k, 3) told by their neighbours: which (j,), and how far off (j, 3), in their axes.

    As for `between`. Those before and after a break are left out altogether.
    """
    found = []
    for first in (1, 2):
        left = np.arange(first, len(known) - 1, 2)
        kept = np.setdiff1d(np.arange(len(known)), left)
        told = between(known[kept], poses[kept], motion)
        left = left[told.share[known[left]] > 0]
        found.append((left, se2.between(poses[left], told.poses[known[left]])))
    rows, miss = (np.concatenate(part) for part in zip(*found, strict=True))
    return rows, miss


def in_map(covariances: Array, heading: Array) -> Array:
    """(n, 3, 3) in map of those in the axes of a robot at `heading` (n,)."""
    R = np.zeros((len(heading), 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(heading)
    R[:, 1, 0] = np.sin(heading)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    spread = R @ covariances @ np.swapaxes(R, 1, 2)
    return (spread + np.swapaxes(spread, 1, 2)) / 2
