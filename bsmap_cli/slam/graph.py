"""SLAM that holds on real logs: tracking, loops, lines, smoothing; the default of `run_slam`."""

import logging

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined, take
from bsmap_cli.model import Array, IntArray, LineMap, LoopClosures, ScanLog, SlamMap, StepStatistics, Trajectory
from bsmap_cli.params import SlamParams
from bsmap_cli.slam.latency import lined_up, odometry_delay
from bsmap_cli.slam.lines import MappedLines, map_lines
from bsmap_cli.slam.loops import Closures, close_loops, is_loop
from bsmap_cli.slam.marginals import Marginals, marginals
from bsmap_cli.slam.motion import beam_motion, odometry_motion
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.segments import Segments, extract_segments, scan_batches
from bsmap_cli.slam.smoothing import Evidence, Smoothed, smooth
from bsmap_cli.slam.submaps import agree
from bsmap_cli.slam.tracking import MATCH_FLOOR, Tracking, limited, track_scans
from bsmap_cli.slam.upkeep import with_positive_offset
from bsmap_cli.track import Track

logger = logging.getLogger("bsmap")

NO_ODOMETRY = np.array([0.1, 0.1, 0.05])
ODOMETRY_FLOOR = np.array([0.003, 0.003, 0.002])
"""Metres and radians by which a step between key scans may be off: as it was tracked, and by odometry at the least."""
OWN_SHARE, OWN_FLOOR = np.array([0.22, 0.22, 0.38]), np.array([0.0003, 0.0003, 0.0001])
"""Of the standard deviation of a step, what a single match errs by, and that at the least (metres, radians); the rest
of a step's allows for what neighbours have in common."""


def run_graph(log: ScanLog, range_sigma: float, params: SlamParams, track: Track) -> SlamMap:
    """Trajectory and line map by matching, loop closing, the line filter and smoothing of all of it."""
    log, tracking = _tracked(log, range_sigma, params, track)
    closures = close_loops(tracking, range_sigma, track)
    segments = _key_segments(log, tracking.keys, range_sigma, params)
    mapped = map_lines(closures.poses, segments, params)
    every = Evidence(closures.chain, closures.closures)
    odometry = _odometry_edges(log, tracking, closures.chain, params)
    distinct = Evidence(odometry, _unexplained(log, tracking, closures, segments))
    smoothed = smooth(closures.poses, every, distinct, segments, mapped.lines, params)
    known = marginals(smoothed.information, len(smoothed.poses), len(smoothed.lines))
    trajectory = Trajectory(log.horizontal.time_ns, *_every_scan(tracking, smoothed.poses, known))
    scans = log.horizontal
    statistics = _statistics(mapped, tracking.keys, len(scans.time_ns))
    return SlamMap(
        trajectory,
        _line_map(smoothed, known),
        statistics,
        log.vertical,
        scans.mount,
        scans.frame_id,
        _loops(closures, tracking),
        tracking.poses,
    )


def _tracked(log: ScanLog, range_sigma: float, params: SlamParams, track: Track) -> tuple[ScanLog, Tracking]:
    """The scans tracked, once more with odometry and laser lined up where their stamps turn out to disagree."""
    tracking = track_scans(log, range_sigma, params, track)
    if log.odometry is None:
        return log, tracking
    delay = odometry_delay(log.horizontal.time_ns, tracking.poses, log.odometry, tracking.matched)
    if delay == 0.0:
        return log, tracking
    way = "behind" if delay > 0 else "ahead of"
    logger.warning("stamps of the horizontal laser are %.2f s %s those of the odometry; lined up", abs(delay), way)
    log = lined_up(log, delay)
    return log, track_scans(log, range_sigma, params, track)


def _key_segments(log: ScanLog, keys: IntArray, range_sigma: float, params: SlamParams) -> Segments:
    """Segments of the key scans; `scan` counts key scans."""
    scans = log.horizontal
    laser = se2.from_matrix(scans.mount)[:2]
    batches = scan_batches(scans, keys, beam_motion(log))
    return joined([extract_segments(points, laser, range_sigma, params) for _, points in batches])


def _odometry_edges(log: ScanLog, tracking: Tracking, chain: Edges, params: SlamParams) -> Edges:
    """The chain by odometry alone; without odometry, that the robot went about as it was tracked."""
    if log.odometry is None:
        information = np.broadcast_to(np.diag(1.0 / NO_ODOMETRY**2), (len(chain.first), 3, 3))
        return chain._replace(information=information.copy())
    before, after = (log.odometry[tracking.keys[end]] for end in (chain.first, chain.second))
    scale = tracking.odometry_scale
    motions = [odometry_motion(a, b, params, scale) for a, b in zip(before, after, strict=True)]
    relative = np.array([motion.increment for motion in motions]).reshape(-1, 3)
    noise = np.array([motion.noise for motion in motions]).reshape(-1, 3, 3) + np.diag(ODOMETRY_FLOOR) ** 2
    # Single readings may be far off: then the edge gives way.
    return Edges(chain.first, chain.second, relative, np.linalg.inv(noise), np.ones(len(relative), bool))


def _unexplained(log: ScanLog, tracking: Tracking, closures: Closures, segments: Segments) -> Edges:
    """Matches of the chain with what they know beyond the lines, and the closures.

    The points of a scan that lie on lines speak through those; to count them in the match as well would make the same
    noise count twice. What is left is taken in proportion to the points.
    """
    points = np.isfinite(log.horizontal.ranges[tracking.keys]).sum(axis=1)
    on_lines = np.bincount(segments.scan, weights=segments.points, minlength=len(tracking.keys))
    share = np.clip(1.0 - on_lines / np.maximum(points, 1), 0.0, 1.0)
    chain = closures.chain
    information = tracking.match_information[chain.second - 1] * share[chain.second, None, None]
    failed = tracking.weak[chain.second]
    information[failed] = 0.0
    matches = chain._replace(information=limited(information, MATCH_FLOOR))
    return joined([matches, closures.closures])


def _every_scan(tracking: Tracking, poses: Array, known: Marginals) -> tuple[Array, Array, Array]:
    """Poses (n, 3), covariances (n, 3, 3) and modes (n, 3, k) of all scans from those of the key scans.

    Between two key scans the tracked motion is kept; what it misses of the way to the second one is spread over it,
    unless it is a break: then all follow the first. So the error is a share of either key scan's, which are correlated,
    and of the match's own.
    """
    n, keys, tracked = len(tracking.poses), tracking.keys, tracking.poses
    before = np.searchsorted(keys, np.arange(n), side="right") - 1
    after = np.minimum(before + 1, len(keys) - 1)
    forward = se2.compose(poses[before], se2.between(tracked[keys[before]], tracked))
    backward = se2.compose(poses[after], se2.between(tracked[keys[after]], tracked))
    span = np.maximum(keys[after] - keys[before], 1)
    share = np.where((after > before) & agree(forward, backward), (np.arange(n) - keys[before]) / span, 0.0)[:, None]
    miss = backward - forward
    miss[:, 2] = se2.wrap(miss[:, 2])
    every = forward + share * miss
    every[:, 2] = se2.wrap(every[:, 2])
    first, second = 1.0 - share[..., None], share[..., None]
    cross = known.following[before] + np.swapaxes(known.following[before], 1, 2)
    spread = first**2 * known.poses[before] + second**2 * known.poses[after] + first * second * cross
    between = (share[:, 0] > 0) & (share[:, 0] < 1)
    spread[between] += _match_covariances(tracking, every[between, 2], before[between])
    return every, spread, first * known.modes[before] + second * known.modes[after]


def _match_covariances(tracking: Tracking, heading: Array, key: IntArray) -> Array:
    """(k, 3, 3) in map, of the tracked place of scans at `heading` (k,) after key scans `key` (k,) beside these.

    That of a step from key scan to key scan, less its allowances for what neighbouring matches have in common.
    """
    common = np.diag(MATCH_FLOOR**2)
    own = np.linalg.inv(tracking.edges.information[key]) - common
    step = own * np.outer(OWN_SHARE, OWN_SHARE) + np.diag(OWN_FLOOR**2)
    R = np.zeros((len(key), 3, 3))
    R[:, 0, 0] = R[:, 1, 1] = np.cos(heading)
    R[:, 1, 0] = np.sin(heading)
    R[:, 0, 1] = -R[:, 1, 0]
    R[:, 2, 2] = 1.0
    spread = R @ step @ np.swapaxes(R, 1, 2)
    return (spread + np.swapaxes(spread, 1, 2)) / 2


def _loops(closures: Closures, tracking: Tracking) -> LoopClosures:
    """Loops between key scans as those between scans, the refused ones last."""
    parts = [take(edges, is_loop(closures.poses, edges)) for edges in (closures.closures, closures.refused)]
    held = np.repeat([True, False], [len(part.first) for part in parts])
    found = joined(parts)
    return LoopClosures(tracking.keys[found.first], tracking.keys[found.second], found.relative, held)


def _line_map(smoothed: Smoothed, known: Marginals) -> LineMap:
    """Lines that key scans saw, with r >= 0."""
    seen = smoothed.hits > 0
    return with_positive_offset(smoothed.lines[seen], known.lines[seen], smoothed.extents[seen], smoothed.hits[seen])


def _statistics(mapped: MappedLines, keys: IntArray, count: int) -> StepStatistics:
    """The filter's figures at the key scans; the scans between them see and match nothing, what is stored stays."""
    rows = np.zeros((count, 3), int)
    rows[keys] = mapped.counts
    nis = np.zeros(count)
    nis[keys] = mapped.nis
    stored = mapped.counts[np.searchsorted(keys, np.arange(count), side="right") - 1, 1]
    return StepStatistics(rows[:, 0], stored, rows[:, 2], nis, 2 * rows[:, 2])
