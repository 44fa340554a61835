"""Tracking: every scan that moved is matched to the map of the last key scans, started from the motion prior."""

import math
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined, take
from bsmap_cli.model import Array, IntArray, ScanLog
from bsmap_cli.params import SlamParams
from bsmap_cli.slam.matching import (
    Match,
    OrientedPoints,
    make_target,
    match,
    oriented_points,
    search,
)
from bsmap_cli.slam.motion import (
    MAX_SPEED,
    MAX_TURN_RATE,
    Motion,
    OdometryScale,
    beam_motion,
    constant_velocity,
    odometry_motion,
)
from bsmap_cli.slam.moving import Watch
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.segments import scan_batches
from bsmap_cli.slam.visibility import LocalMap, Views, agreeing
from bsmap_cli.track import Track

WINDOW = 10
"""Key scans that make the local map: enough to reach behind a robot that sees 180 degrees."""
GOOD, WEAK, NEAR, FAR = 0.75, 0.5, 9.0, 16.0
"""Shares on which scan and map agree, and squared distances from the prediction, in standard deviations.

Below the first share, or not near, a wider search is worth its time; below the second, or below the first and far, the
match is not believed and the prediction stands."""
DEPARTURE_COST = 0.1
"""Share that a match must agree more when its squared distance from the prediction is e times as large: a slip may be
of any size."""
MATCH_FLOOR = np.array([0.003, 0.003, 0.0015])
"""Metres and radians that a match is off at the least, for walls are rough."""
MOST_POINTS, CLOSE_REACH = 400, 0.3
"""Points of a scan; metres within which they pair where the prediction is trusted."""
FEW, STIFF = 0.15, 0.002
"""Share of normals along a corridor that are too few to contradict odometry there; metres that hold a match to it."""
JUMP, GAP, STILL = (0.5, 0.5), 10.0, 0.01
"""Metres and radians of odometry beyond what speed allows, and seconds, after which a robot may be anywhere; metres
and radians that are no motion."""
LEAST_SPREAD = np.array([0.02, 0.02, 0.01])
"""Metres and radians by which a prediction can be off however short the step."""


class Tracking(NamedTuple):
    """poses : (n, 3), of every scan, in the frame of the first.  keys : (k,) scans that became key scans.

    points : of each key scan, in base_link, less those that move.
    edges : from each key scan but the first to an earlier one.
    match_information : (k - 1, 3, 3), what the match alone says of each edge.
    weak : (k,) key scans whose match failed, so that their edge holds no more than the motion prior.
    adrift : (k,) key scans before which nothing tells the motion: no odometry, a jump of it, or a long gap.
    odometry_scale : metres of way for a metre of odometry.  matched : (n,) scans that a good match placed.
    views : of the laser.
    """

    poses: Array
    keys: IntArray
    points: list[OrientedPoints]
    edges: Edges
    match_information: Array
    weak: NDArray[np.bool_]
    adrift: NDArray[np.bool_]
    odometry_scale: float
    matched: NDArray[np.bool_]
    views: Views


def track_scans(log: ScanLog, range_sigma: float, params: SlamParams, track: Track) -> Tracking:
    """Poses of all scans by matching each to the local map."""
    n = len(log.horizontal.time_ns)
    poses = np.zeros((n, 3))
    keys, key_points, priors, by_match, shares, agreed = [0], [], [], [], [1.0], [1.0]
    last, before, scale, matched = 0, 0, OdometryScale(), np.zeros(n, bool)
    noise = match_noise(range_sigma)
    scans = _points_of_scans(log, range_sigma)
    key_points.append(next(scans))
    views = Views(log.horizontal)
    placed, watch, seen = [key_points[0]], Watch(views), [views.view(0, poses[0])]
    moves = [watch.add(seen[0], placed[0], True)]
    broken = adrift(log, np.arange(n)) if log.odometry is not None else np.zeros(n, bool)
    target = make_target(placed[0])
    for k, points in enumerate(scans, 1):
        track("slam: tracking", k + 1, n)
        prior = _motion(log, poses, before, last, k, params, scale.value)
        predicted = se2.compose(poses[last], prior.increment)
        poses[k] = predicted
        if log.odometry is not None and not _moved(prior.increment, params.match_distance, params.match_angle):
            continue
        local = LocalMap(target, seen, views)
        placing = _match(k, points, local, predicted, prior, noise)
        if log.odometry is not None:
            told = odometry_motion(log.odometry[keys[-1]], log.odometry[k], params, scale.value)
            placing = _not_drawn(placing, k, points, local, poses[keys[-1]], told, noise)
        found, agrees = placing
        poses[k], matched[k] = found.pose, found.inliers >= GOOD
        before, last = last, k
        step = se2.between(poses[keys[-1]], poses[k])
        if not _moved(step, params.key_distance, params.key_angle):
            continue
        shares.append(found.inliers)
        agreed.append(agrees)
        by_match.append(_in_frame_of(predicted, found.information))
        priors.append(prior.noise)
        if log.odometry is not None and min(shares[-2:]) >= GOOD:
            scale = scale.seen(se2.between(log.odometry[keys[-1]], log.odometry[k]), step, by_match[-1])
        keys.append(k)
        key_points.append(points)
        placed = [*placed[-WINDOW:], points.moved(poses[k])]
        if broken[keys[-2] + 1 : k + 1].any():
            watch, seen = Watch(views), []  # what was seen before may be of another place
        view = views.view(k, poses[k])
        moves.append(watch.add(view, placed[-1], agrees >= WEAK))
        if agrees >= WEAK:
            seen = [*seen[1 - WINDOW :], view]
        target = make_target(joined([_standing(placed[j - len(keys)], moves[j]) for j in _local(agreed)]))
    weak = np.array(agreed) < WEAK
    match_information = np.array(by_match).reshape(-1, 3, 3)
    information = _edge_information(match_information, np.array(priors).reshape(-1, 3, 3), weak[1:])
    chain = _chain(poses[keys], information, weak, np.array(shares) < GOOD)
    drifts = adrift(log, np.array(keys))
    key_points = [_standing(*both) for both in zip(key_points, moves, strict=True)]
    return Tracking(
        poses, np.array(keys), key_points, chain, match_information, weak, drifts, scale.value, matched, views
    )


def _standing(points: OrientedPoints, moves: NDArray[np.bool_]) -> OrientedPoints:
    return take(points, ~moves) if moves.any() else points


def adrift(log: ScanLog, keys: IntArray) -> NDArray[np.bool_]:
    """(k,) key scans to which the robot did not get from the one before in the way that odometry and stamps tell."""
    if log.odometry is None:
        return np.arange(len(keys)) > 0
    seconds = np.diff(log.horizontal.time_ns[keys]) * 1e-9
    odometry = log.odometry[keys]
    step = np.abs(se2.between(odometry[:-1], odometry[1:]))
    step = np.column_stack([np.hypot(step[:, 0], step[:, 1]), step[:, 2]])
    time = np.maximum(seconds, 0.0)[:, None]
    jump = (step > np.array(JUMP) + np.array([MAX_SPEED, MAX_TURN_RATE]) * time).any(axis=1)
    gap = seconds > GAP
    # Logs that take a scan a metre have gaps where the robot stands; then odometry goes on as between other scans.
    usual = 1.5 * step[~gap].max(axis=0, initial=0.0)
    anew = (np.abs(odometry[1:] - odometry[0]) < STILL).all(axis=1)
    goes_on = (step <= usual).all(axis=1) & (step > STILL).any(axis=1) & ~anew
    return np.concatenate([[False], jump | (gap & ~goes_on)])


def _local(agreed: list[float]) -> list[int]:
    """Last key scans that make the local map: a single failed one stays out, for its place is doubtful.

    Of several in a row, as where the robot turns into a room that it has not seen, each helps to place the next.
    """
    failed = [False, *(share < WEAK for share in agreed[-WINDOW - 1 :]), False]
    first = len(agreed) - (len(failed) - 2)
    alone = [
        now and not before and not after for before, now, after in zip(failed, failed[1:], failed[2:], strict=False)
    ]
    return [first + j for j, single in enumerate(alone) if not single][-WINDOW:]


def match_noise(range_sigma: float) -> float:
    """Standard deviation of a point's distance to the map, metres: walls are rough, and neighbours err together."""
    return max(3 * range_sigma, 0.03)


def _moved(increment: Array, distance: float, angle: float) -> bool:
    x, y, turn = increment.tolist()
    return math.hypot(x, y) >= distance or abs(turn) >= angle


def _motion(log: ScanLog, poses: Array, before: int, last: int, k: int, params: SlamParams, scale: float) -> Motion:
    """Prior of the motion from scan `last` to scan k."""
    if log.odometry is not None:
        return odometry_motion(log.odometry[last], log.odometry[k], params, scale)
    time = log.horizontal.time_ns
    seconds, earlier = (max(float(d) * 1e-9, 0.0) for d in (time[k] - time[last], time[last] - time[before]))
    return constant_velocity(se2.between(poses[before], poses[last]), earlier, seconds, params)


class _Placed(NamedTuple):
    """A match, and the share of what both could see on which scan and map agree."""

    match: Match
    agreement: float


def _match(
    scan: int, points: OrientedPoints, local: LocalMap, predicted: Array, prior: Motion, noise: float
) -> _Placed:
    """Match from the prediction; where that is poor, from the best places of a wider search; else the prediction."""
    spread = np.sqrt(prior.noise.diagonal()) + LEAST_SPREAD
    information = np.zeros((3, 3))
    np.fill_diagonal(information, spread**-2)
    place, _, heading = spread.tolist()
    reach = min(max(0.2 + 4 * place + 2 * heading, 0.3), 1.0)
    best = match(points, local.target, predicted, information, noise, reach)
    near = _departure(best, predicted, spread) < NEAR
    if near and best.inliers >= GOOD:
        return _Placed(best, best.inliers)

    def placed(found: Match) -> _Placed:
        """With what nobody saw before left out; but far from the prediction that is no excuse."""
        agreement = agreeing(found, scan, points, local, noise)
        far = _departure(found, predicted, spread) >= FAR
        return _Placed(found, min(agreement, found.inliers) if far else agreement)

    chosen = placed(best)
    if near and chosen.agreement >= GOOD:
        return chosen
    # Pairs from far away draw a robot that sees much of what is new to where it was before.
    close = placed(match(points, local.target, predicted, information, noise, CLOSE_REACH))
    if _worth(close, predicted, spread) > _worth(chosen, predicted, spread):
        chosen = close
    span, turn = min(0.3 + 3 * place, 1.5), min(0.12 + 3 * heading, 1.0)
    loose = information / 100
    for start in search(points, local.target, predicted, span, turn):
        coarse = match(points, local.target, start, loose, noise, 0.5)
        fine = placed(match(points, local.target, coarse.pose, loose, noise, 0.15))
        if _worth(fine, predicted, spread) > _worth(chosen, predicted, spread):
            chosen = fine
    credible = chosen.agreement >= (WEAK if _departure(chosen.match, predicted, spread) < FAR else GOOD)
    return chosen if credible else _Placed(Match(predicted, np.zeros((3, 3)), 0.0, 0.0), 0.0)


def _not_drawn(
    placed: _Placed, scan: int, points: OrientedPoints, local: LocalMap, key: Array, told: Motion, noise: float
) -> _Placed:
    """The match; or, if few points draw it far from where odometry has the robot, the one where odometry is right.

    Who walks beside a robot between bare walls looks like a place that it does not leave.
    told : motion since the last key scan, which was at `key` (3,).
    """
    predicted, spread = se2.compose(key, told.increment), np.sqrt(told.noise.diagonal()) + LEAST_SPREAD
    found = placed.match
    away = (predicted - found.pose)[:2]
    if away @ away < NEAR * spread[0] ** 2 or not len(points.xy):
        return placed
    normal = points.moved(found.pose).normal
    shares, axes = np.linalg.eigh(normal.T @ normal / len(normal))
    along = axes[:, 0]
    if shares[0] > FEW or (along @ away) ** 2 < NEAR * spread[0] ** 2:
        return placed
    stiff = np.zeros((3, 3))
    stiff[:2, :2] = np.outer(along, along) / STIFF**2
    start = found.pose.copy()
    start[:2] += along * (along @ away)
    held = match(points, local.target, start, stiff, noise, CLOSE_REACH)
    known = held.information[:, :2] @ along
    least = max(float(along @ known[:2]), 1e-9)
    held = held._replace(information=held.information - np.outer(known, known) / least)
    other = _Placed(held, agreeing(held, scan, points, local, noise))
    better = _worth(other, predicted, spread) > _worth(placed, predicted, spread)
    return other if better and other.agreement >= GOOD else placed


def _departure(found: Match, predicted: Array, spread: Array) -> float:
    """Squared distance from the prediction, in standard deviations `spread` (3,)."""
    (x, y, theta), (a, b, c) = (found.pose - predicted).tolist(), spread.tolist()
    return (x / a) ** 2 + (y / b) ** 2 + (se2.wrap_one(theta) / c) ** 2


def _worth(found: _Placed, predicted: Array, spread: Array) -> float:
    """Share on which scan and map agree, less what leaving the prediction costs.

    A robot that turns where it has not been sees little that it knows: only a much better match may contradict the
    prediction, and then (a slipping wheel, lost scans) how far it does so matters less and less.
    """
    return found.agreement - DEPARTURE_COST * math.log1p(_departure(found.match, predicted, spread))


def _in_frame_of(pose: Array, information: Array) -> Array:
    """Information (3, 3) of a pose in map, in the axes of the robot at `pose`."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R.T @ information @ R)


def _edge_information(by_match: Array, noise: Array, failed: NDArray[np.bool_]) -> Array:
    """(m, 3, 3) information of steps to key scans by matches and by priors with `noise` (m, 3, 3), in the robot's axes.

    A failed match adds nothing to the prior.
    """
    odometry = np.linalg.inv(noise + np.diag(LEAST_SPREAD) ** 2)
    return np.where(failed[:, None, None], odometry / 4, limited(by_match + odometry, MATCH_FLOOR))


def limited(information: Array, floor: Array) -> Array:
    """Information (..., 3, 3) when errors with standard deviations `floor` (3,) come on top; it may be singular."""
    both = np.asarray(np.linalg.solve(np.eye(3) + information * floor**2, information), dtype=np.float64)
    return (both + np.swapaxes(both, -1, -2)) / 2


def _chain(poses: Array, information: Array, failed: NDArray[np.bool_], poor: NDArray[np.bool_]) -> Edges:
    """Edges between key scans: from the one before or, past a single failed one, from the one before that.

    For a match is one to the map of all. A failed one hangs on the last sound one: a single bad reading of the odometry
    may be all there is to it. Edges of a poor match may give way where loops contradict them.
    """
    second = np.arange(1, len(poses))
    before = np.concatenate([[False], failed])  # shifted by one, so that there is one before the first
    alone = failed[second - 1] & ~before[second - 1] & ~failed[second]
    sound = np.maximum.accumulate(np.where(failed, 0, np.arange(len(poses))))
    first = np.where(failed[second], sound[second - 1], second - 1 - alone)
    relative = se2.between(poses[first], poses[second])
    return Edges(first, second, relative, information, poor[1:])


def _points_of_scans(log: ScanLog, range_sigma: float) -> Iterator[OrientedPoints]:
    """Oriented points of each horizontal scan in turn, at most MOST_POINTS of each."""
    scans = log.horizontal
    laser = se2.from_matrix(scans.mount)[:2]
    for some, points in scan_batches(scans, np.arange(len(scans.time_ns)), beam_motion(scans, log.odometry)):
        oriented, index = oriented_points(points, laser, range_sigma)
        border = np.searchsorted(points.scan[index], np.arange(some.start, some.stop + 1))
        for a, b in pairwise(border.tolist()):
            step = -(-(b - a) // MOST_POINTS) or 1
            yield OrientedPoints(oriented.xy[a:b:step], oriented.normal[a:b:step])
