"""SLAM that holds on real logs: tracking, loops, lines, smoothing; the default of `run_slam`."""

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import Array, IntArray, LineMap, ScanLog, SlamMap, StepStatistics, Trajectory
from bsmap_cli.params import SlamParams
from bsmap_cli.slam.lines import MappedLines, map_lines
from bsmap_cli.slam.loops import close_loops
from bsmap_cli.slam.marginals import Marginals, marginals
from bsmap_cli.slam.motion import beam_motion
from bsmap_cli.slam.segments import Segments, extract_segments, scan_points
from bsmap_cli.slam.smoothing import Smoothed, smooth
from bsmap_cli.slam.tracking import Tracking, track_scans
from bsmap_cli.slam.upkeep import with_positive_offset
from bsmap_cli.track import Track


def run_graph(log: ScanLog, range_sigma: float, params: SlamParams, track: Track) -> SlamMap:
    """Trajectory and line map by matching, loop closing, the line filter and smoothing of all of it."""
    tracking = track_scans(log, range_sigma, params, track)
    closures = close_loops(tracking, range_sigma, track)
    segments = _key_segments(log, tracking.keys, range_sigma, params)
    mapped = map_lines(closures.poses, segments, params)
    smoothed = smooth(closures.poses, closures.edges, segments, mapped.lines, params.gate, params.overlap_margin)
    known = marginals(smoothed.information, len(smoothed.poses), len(smoothed.lines))
    trajectory = Trajectory(log.horizontal.time_ns, *_every_scan(tracking, smoothed.poses, known.poses))
    scans = log.horizontal
    statistics = _statistics(mapped, tracking.keys, len(scans.time_ns))
    return SlamMap(trajectory, _line_map(smoothed, known), statistics, log.vertical, scans.mount, scans.frame_id)


def _key_segments(log: ScanLog, keys: IntArray, range_sigma: float, params: SlamParams) -> Segments:
    """Segments of the key scans; `scan` counts key scans."""
    scans = log.horizontal
    mount = se2.from_matrix(scans.mount)
    points = scan_points(scans.ranges[keys], scans.angles, mount, beam_motion(log)[keys])
    return extract_segments(points, mount[:2], range_sigma, params)


def _every_scan(tracking: Tracking, poses: Array, covariances: Array) -> tuple[Array, Array]:
    """Poses (n, 3) and covariances (n, 3, 3) of all scans from those of the key scans.

    Between two key scans the tracked motion is kept; what it misses of the way to the second one is spread over it.
    """
    n, keys, tracked = len(tracking.poses), tracking.keys, tracking.poses
    before = np.searchsorted(keys, np.arange(n), side="right") - 1
    after = np.minimum(before + 1, len(keys) - 1)
    forward = se2.compose(poses[before], se2.between(tracked[keys[before]], tracked))
    backward = se2.compose(poses[after], se2.between(tracked[keys[after]], tracked))
    span = np.maximum(keys[after] - keys[before], 1)
    share = np.where(after > before, (np.arange(n) - keys[before]) / span, 0.0)[:, None]
    miss = backward - forward
    miss[:, 2] = se2.wrap(miss[:, 2])
    every = forward + share * miss
    every[:, 2] = se2.wrap(every[:, 2])
    return every, covariances[before] + share[..., None] * (covariances[after] - covariances[before])


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
