"""The paper's SLAM: the line-segment EKF alone on the motion prior, method.md sections 1-4."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import Array, ScanLog, SlamMap, StepStatistics, Trajectory
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import filter
from bsmap_cli.slam.association import find_candidates, partial_compatibility
from bsmap_cli.slam.filter import FilterState
from bsmap_cli.slam.motion import Motion, beam_motion, constant_velocity, odometry_motion
from bsmap_cli.slam.segments import Segments, extract_segments, scan_batches
from bsmap_cli.slam.upkeep import (
    Landmarks,
    append,
    extend,
    extents_in_map,
    follow,
    join_lines,
    no_landmarks,
    prune,
    to_line_map,
)
from bsmap_cli.track import Track


class Step(NamedTuple):
    """The map after a scan, and what the scan did: new segments, matched pairs, normalised innovation squared."""

    state: FilterState
    landmarks: Landmarks
    matched: int
    nis: float


def run_paper(log: ScanLog, range_sigma: float, params: SlamParams, track: Track) -> SlamMap:
    """Trajectory and line map by the filter alone: what it loses it does not find again."""
    scans = log.horizontal
    n = len(scans.time_ns)
    poses, covariances = np.empty((n, 3)), np.empty((n, 3, 3))
    counts, nis = np.zeros((n, 3), int), np.zeros(n)
    state, landmarks, last_key, step = filter.initial_state(), no_landmarks(), 0, 0
    motions = _Motions(log, params)
    for k, segments in enumerate(_segments(log, range_sigma, params)):
        moved = motions.to(k, poses)
        if k > 0:
            state = filter.predict(state, moved.increment, moved.noise)
        matched = 0
        # Without odometry only the scan itself can tell that the robot moved.
        if k == 0 or log.odometry is None or _is_key(poses[last_key], state.pose, params):
            state, landmarks, matched, nis[k] = line_step(state, landmarks, segments, step, params)
            last_key, step = k, step + 1
        poses[k], covariances[k] = state.pose, filter.pose_covariance(state)
        counts[k] = len(segments.scan), len(landmarks.hits), matched
        track("slam: scans", k + 1, n)
    statistics = StepStatistics(counts[:, 0], counts[:, 1], counts[:, 2], nis, 2 * counts[:, 2])
    trajectory = Trajectory(scans.time_ns, poses, covariances)
    lines = to_line_map(state, landmarks)
    return SlamMap(trajectory, lines, statistics, log.vertical, scans.mount, scans.frame_id)


def line_step(state: FilterState, landmarks: Landmarks, segments: Segments, step: int, params: SlamParams) -> Step:
    """Match the segments, correct by them, store what is new, join what is one, forget what does not last."""
    candidates = find_candidates(state, landmarks.extents, segments, params.gate, params.overlap_margin)
    order = np.argsort(_bearings(segments), kind="stable").tolist()
    chosen = partial_compatibility(candidates, order, params.group_size, params.gate)
    segment, line = candidates.segment[chosen], candidates.line[chosen]
    before = state.lines.copy()
    state, nis = filter.update(state, line, segments.parameters[segment], segments.covariances[segment])
    landmarks = extend(state, follow(landmarks, before, state.lines), segments, segment, line, step)
    # A segment that fits a line alone but not jointly is neither trusted nor stored a second time.
    fits = np.zeros(len(segments.scan), bool)
    fits[candidates.segment] = True
    unknown = np.flatnonzero(~fits)
    first_new = len(landmarks.hits)
    for new in unknown:
        state = filter.augment(state, segments.parameters[new], segments.covariances[new])
    if len(unknown):
        seen = extents_in_map(state.pose, segments.parameters[unknown], segments.extents[unknown])
        landmarks = append(landmarks, seen, step)
    touched = sorted({*line.tolist(), *range(first_new, len(landmarks.hits))})
    same = np.array([[params.line_angle_floor**2, 0.0], [0.0, params.line_offset_floor**2]])
    state, landmarks = join_lines(state, landmarks, touched, params.gate, params.overlap_margin, same)
    state, landmarks = prune(state, landmarks, step, params.tentative_hits, params.tentative_scans)
    return Step(state, landmarks, len(chosen), nis)


def _bearings(segments: Segments) -> Array:
    """(k,) direction from the robot to the middle of each segment, radians."""
    alpha, r = segments.parameters.T
    middle = (segments.extents[:, 0] + segments.extents[:, 1]) / 2
    return se2.wrap(alpha + np.arctan2(middle, r))


def _is_key(last: Array, pose: Array, params: SlamParams) -> bool:
    """Whether the robot moved enough since the last scan that was used for a new one to bring something."""
    moved = se2.between(last, pose)
    return bool(np.hypot(moved[0], moved[1]) >= params.update_distance or abs(moved[2]) >= params.update_angle)


class _Motions(NamedTuple):
    """The motion prior from scan to scan, by odometry or, without it, by the velocity of the step before."""

    log: ScanLog
    params: SlamParams

    def to(self, k: int, poses: Array) -> Motion:
        """Motion from scan k - 1 to scan k; `poses` (n, 3) holds the estimates up to k - 1."""
        odometry, time_ns = self.log.odometry, self.log.horizontal.time_ns
        if k == 0:
            return Motion(np.zeros(3), np.zeros((3, 3)))
        if odometry is not None:
            return odometry_motion(odometry[k - 1], odometry[k], self.params)
        seconds = max(float(time_ns[k] - time_ns[k - 1]) * 1e-9, 0.0)
        before = max(float(time_ns[k - 1] - time_ns[k - 2]) * 1e-9, 0.0) if k > 1 else 0.0
        last = se2.between(poses[k - 2], poses[k - 1]) if k > 1 else np.zeros(3)
        return constant_velocity(last, before, seconds, self.params)


def _segments(log: ScanLog, range_sigma: float, params: SlamParams) -> Iterator[Segments]:
    """Segments of each horizontal scan in turn."""
    scans = log.horizontal
    laser = se2.from_matrix(scans.mount)[:2]
    for some, points in scan_batches(scans, np.arange(len(scans.time_ns)), beam_motion(scans, log.odometry)):
        found = extract_segments(points, laser, range_sigma, params)
        for k in some:
            yield found.of_scan(k)
