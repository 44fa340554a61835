"""SLAM that holds on real logs: tracking, loops, lines, smoothing; the default of `run_slam`."""

import logging

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined, take
from bsmap_cli.model import IntArray, LineMap, LoopClosures, ScanLog, SlamMap, StepStatistics, Trajectory
from bsmap_cli.params import SlamParams
from bsmap_cli.slam.between import evenly, every_scan
from bsmap_cli.slam.candidates import is_loop
from bsmap_cli.slam.latency import lined_up, odometry_delay
from bsmap_cli.slam.lines import MappedLines, map_lines
from bsmap_cli.slam.loops import Closures, close_loops
from bsmap_cli.slam.marginals import Marginals, marginals
from bsmap_cli.slam.motion import beam_motion, odometry_motion
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.segments import Segments, extract_segments, scan_batches
from bsmap_cli.slam.smoothing import Evidence, Smoothed, smooth
from bsmap_cli.slam.tracking import MATCH_FLOOR, Tracking, limited, track_scans
from bsmap_cli.slam.upkeep import with_positive_offset
from bsmap_cli.track import Track

logger = logging.getLogger("bsmap")

NO_ODOMETRY = np.array([0.1, 0.1, 0.05])
ODOMETRY_FLOOR = np.array([0.003, 0.003, 0.002])
"""Metres and radians by which a step between key scans may be off: as it was tracked, and by odometry at the least."""


def run_graph(log: ScanLog, range_sigma: float, params: SlamParams, track: Track) -> SlamMap:
    """Trajectory and line map by matching, loop closing, the line filter and smoothing of all of it."""
    log, tracking = _tracked(log, range_sigma, params, track)
    if log.odometry is not None:
        tracking = evenly(tracking, log.odometry)
    closures = close_loops(tracking, range_sigma, track)
    segments = _key_segments(log, tracking, range_sigma, params)
    mapped = map_lines(closures.poses, segments, params)
    every = Evidence(closures.chain, closures.closures)
    odometry = _odometry_edges(log, tracking, closures.chain, params)
    distinct = Evidence(odometry, _unexplained(log, tracking, closures, segments))
    smoothed = smooth(closures.poses, every, distinct, segments, mapped.lines, params)
    known = marginals(smoothed.information, len(smoothed.poses), len(smoothed.lines))
    scans = log.horizontal
    trajectory = Trajectory(scans.time_ns, *every_scan(scans, tracking, smoothed, known, odometry))
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


def _key_segments(log: ScanLog, tracking: Tracking, range_sigma: float, params: SlamParams) -> Segments:
    """Segments of the key scans; `scan` counts key scans."""
    scans = log.horizontal
    laser = se2.from_matrix(scans.mount)[:2]
    batches = scan_batches(scans, tracking.keys, beam_motion(scans, tracking.poses))
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
