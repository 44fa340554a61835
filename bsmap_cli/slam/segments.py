"""Line segments from horizontal scans, method.md section 1: breakpoints, split and merge, weighted fit, covariance.

Scans are worked on many at a time: all points in one flat array, segments as ranges [start, end) of it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.table import take
from bsmap_cli.model import Array, IntArray, LaserScans
from bsmap_cli.params import SlamParams

BATCH = 128
"""Scans worked on at once."""
MAX_MISSING = 5
"""Beams without return that a segment may bridge."""


class ScanPoints(NamedTuple):
    """Valid points of many scans, by scan, then beam.

    scan, beam : (n,).  xy : (n, 2) in base_link at the scan's stamp, metres.  direction : (n, 2), of the beam there.
    range : (n,), metres.  angle : (n,), of the beam in the laser's frame, radians.
    """

    scan: IntArray
    beam: IntArray
    xy: Array
    direction: Array
    range: Array
    angle: Array


class Segments(NamedTuple):
    """Line segments in base_link: points p with p . n = r, n = (cos alpha, sin alpha) pointing away from the laser.

    scan : (k,), ascending.  parameters : (k, 2) alpha, r (below 0 where the line passes between laser and base_link's
    origin).  covariances : (k, 2, 2).  extents : (k, 2) along t = (-sin alpha, cos alpha), metres.
    points : (k,) number.  angular : (k, 2), what the noise of the beams' directions adds to the variances of direction
    and, where the points are centred, offset.
    """

    scan: IntArray
    parameters: Array
    covariances: Array
    extents: Array
    points: IntArray
    angular: Array

    def of_scan(self, scan: int) -> "Segments":
        """The segments of one scan."""
        a, b = np.searchsorted(self.scan, [scan, scan + 1])
        return take(self, slice(a, b))


def scan_points(
    ranges: NDArray[np.float32], angles: Array, mount: Array, beam_motion: Array, first_scan: int = 0
) -> ScanPoints:
    """Valid points of scans in base_link, each set back to where the robot was at the scan's first beam.

    ranges : (k, m), nan is no return.  angles : (m,).  mount : (3,), of the laser in base_link.
    beam_motion : (k, 3), of base_link from one beam to the next (x, y, theta), small.
    """
    valid = np.isfinite(ranges)
    scan, beam = np.nonzero(valid)
    r, heading = ranges[valid].astype(float), mount[2] + angles
    direction = np.stack([np.cos(heading), np.sin(heading)], axis=1)[beam]
    xy = mount[:2] + r[:, None] * direction
    if beam_motion.any():
        moved = beam_motion[scan] * beam[:, None]
        turn = moved * [0.0, 0.0, 1.0]
        xy, direction = se2.transform(moved, xy), se2.transform(turn, direction)
    return ScanPoints(scan + first_scan, beam, xy, direction, r, angles[beam])


def scan_batches(scans: LaserScans, chosen: IntArray, beam_motion: Array) -> Iterator[tuple[range, ScanPoints]]:
    """Points of the scans `chosen` (k,), some at a time, so that long logs need no more memory than short ones.

    Yields which of the chosen ones they are, and their points, whose `scan` counts the chosen ones.
    beam_motion : (n, 3) of all scans, see `scan_points`.
    """
    mount = se2.from_matrix(scans.mount)
    for start in range(0, len(chosen), BATCH):
        some = range(start, min(start + BATCH, len(chosen)))
        rows = chosen[start : some.stop]
        yield some, scan_points(scans.ranges[rows], scans.angles, mount, beam_motion[rows], start)


def extract_segments(points: ScanPoints, laser_xy: Array, range_sigma: float, params: SlamParams) -> Segments:
    """Line segments of many scans; `laser_xy` (2,) is the laser's place in base_link."""
    group_start, group_end = _breakpoints(points, range_sigma, params)
    long_enough = group_end - group_start >= params.min_points
    start, end = _split(points.xy, group_start[long_enough], group_end[long_enough], range_sigma, params)
    start, end = _merge(points.xy, start, end, group_start, range_sigma)
    keep = end - start >= params.min_points
    return _fit(points, start[keep], end[keep], laser_xy, range_sigma, params)


def _breakpoints(points: ScanPoints, range_sigma: float, params: SlamParams) -> tuple[IntArray, IntArray]:
    """Groups of neighbouring points: adaptive breakpoint detection (Borges and Aldon 2004)."""
    n = len(points.scan)
    if n == 0:
        return np.zeros(0, int), np.zeros(0, int)
    step = np.diff(points.angle)
    distance = np.hypot(*np.diff(points.xy, axis=0).T)
    swept = np.abs(step)
    limit = np.where(
        swept < params.breakpoint_angle,
        points.range[:-1] * np.sin(swept) / np.sin(np.maximum(params.breakpoint_angle - swept, 1e-6)),
        0.0,
    )
    cut = distance > limit + 3 * range_sigma
    cut |= np.diff(points.scan) != 0
    cut |= np.diff(points.beam) > 1 + MAX_MISSING
    inner = np.flatnonzero(cut) + 1
    return np.r_[0, inner], np.r_[inner, n]


def _split(
    xy: Array, start: IntArray, end: IntArray, range_sigma: float, params: SlamParams
) -> tuple[IntArray, IntArray]:
    """Iterative end-point fit, all segments of a level at once; what noise alone does (4 sigma) splits nothing."""
    done: list[tuple[IntArray, IntArray]] = []
    while len(start):
        flat, first = _flatten(start, end)
        count = end - start
        chord = xy[end - 1] - xy[start]
        # Where the ends coincide, the distance to the start takes the place of that to the chord.
        length = np.hypot(*chord.T)
        closed = length < 1e-6
        chord /= np.where(closed, 1.0, length)[:, None]
        offset = xy[flat] - np.repeat(xy[start], count, axis=0)
        across = np.abs(offset[:, 0] * np.repeat(chord[:, 1], count) - offset[:, 1] * np.repeat(chord[:, 0], count))
        distance = np.where(np.repeat(closed, count), np.hypot(*offset.T), across)
        largest = np.maximum.reduceat(distance, first)
        split = largest > max(params.split_distance, 4 * range_sigma)
        done.append((start[~split], end[~split]))
        if not split.any():
            break
        is_largest = np.flatnonzero(distance == np.repeat(largest, count))
        where = start + is_largest[np.searchsorted(is_largest, first)] - first
        at = np.clip(where[split], start[split] + 1, end[split] - 1)
        start, end = np.r_[start[split], at], np.r_[at, end[split]]
        keep = end - start >= params.min_points
        start, end = start[keep], end[keep]
    starts, ends = (np.concatenate(part) for part in zip(*done, strict=True)) if done else (start, end)
    order = np.argsort(starts, kind="stable")
    return starts[order], ends[order]


def _flatten(start: IntArray, end: IntArray) -> tuple[IntArray, IntArray]:
    """Indices of all points of all segments, one after another, and where each segment begins among them."""
    count = end - start
    first = np.cumsum(count) - count
    return np.arange(count.sum()) + np.repeat(start - first, count), first


def _moments(xy: Array, start: IntArray, end: IntArray) -> Array:
    """(k, 6) n, sum x, y, xx, xy, yy about each segment's scan origin."""
    flat, first = _flatten(start, end)
    if not len(flat):
        return np.zeros((0, 6))
    x, y = xy[flat, 0], xy[flat, 1]
    return np.add.reduceat(np.stack([np.ones(len(flat)), x, y, x * x, x * y, y * y], axis=1), first, axis=0)


def _mean_square(m: Array) -> Array:
    """Mean squared distance of points with moments (k, 6) to their best line: the smaller eigenvalue of the scatter."""
    n = m[:, 0]
    xx = m[:, 3] / n - (m[:, 1] / n) ** 2
    yy = m[:, 5] / n - (m[:, 2] / n) ** 2
    xy = m[:, 4] / n - m[:, 1] * m[:, 2] / n**2
    return np.maximum((xx + yy) / 2 - np.sqrt(((xx - yy) / 2) ** 2 + xy**2), 0.0)


def _merge(
    xy: Array, start: IntArray, end: IntArray, group_start: IntArray, range_sigma: float
) -> tuple[IntArray, IntArray]:
    """Join neighbours of one group that touch and that one line fits as well as two."""
    while len(start) > 1:
        m = _moments(xy, start, end)
        own, joint = _mean_square(m), _mean_square(m[:-1] + m[1:])
        apart = (own[:-1] * m[:-1, 0] + own[1:] * m[1:, 0]) / (m[:-1, 0] + m[1:, 0])
        touch = (start[1:] == end[:-1]) & ~np.isin(start[1:], group_start)
        join = touch & (joint < np.maximum(1.2 * apart, range_sigma**2))
        # In a chain only every other joint is closed in one pass.
        join = _every_other(join)
        if not join.any():
            break
        keep_start, keep_end = np.r_[True, ~join], np.r_[~join, True]
        start, end = start[keep_start], end[keep_end]
    return start, end


def _every_other(flags: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Of each run of set flags the first, third, fifth ..."""
    position = np.arange(len(flags))
    run_start = np.maximum.accumulate(np.where(flags & ~np.r_[False, flags[:-1]], position, 0))
    return flags & ((position - run_start) % 2 == 0)


def _fit(
    points: ScanPoints, start: IntArray, end: IntArray, laser_xy: Array, range_sigma: float, params: SlamParams
) -> Segments:
    """Weighted total least squares of each segment, Eq. (1)-(3), with covariance."""
    flat, first = _flatten(start, end)
    count = end - start
    owner = np.repeat(np.arange(len(start)), count)
    xy, direction, rho = points.xy[flat], points.direction[flat], points.range[flat]

    def total(values: Array) -> Array:
        return np.add.reduceat(values, first) if len(first) else np.zeros(0)

    weight = np.ones(len(flat))
    for _ in range(2):  # the weights depend on the angle of incidence, which the first pass gives
        sum_w = total(weight)
        mean = np.stack([total(weight * xy[:, 0]) / sum_w, total(weight * xy[:, 1]) / sum_w], axis=1)
        d = xy - mean[owner]
        alpha = 0.5 * np.arctan2(-2 * total(weight * d[:, 0] * d[:, 1]), total(weight * (d[:, 1] ** 2 - d[:, 0] ** 2)))
        n = np.stack([np.cos(alpha), np.sin(alpha)], axis=1)
        along = np.einsum("ij,ij->i", n[owner], direction)
        across = n[owner, 1] * direction[:, 0] - n[owner, 0] * direction[:, 1]
        by_angle = (params.angle_sigma * rho * across) ** 2
        weight = 1.0 / ((range_sigma * along) ** 2 + by_angle + (0.1 * range_sigma) ** 2)
    # n points away from the laser, so that the two faces of a thin wall differ by pi.
    flip = np.einsum("ij,ij->i", mean - laser_xy, n) < 0
    alpha = np.where(flip, alpha + np.pi, alpha)
    n = np.where(flip[:, None], -n, n)
    t = np.stack([-n[:, 1], n[:, 0]], axis=1)
    residual = np.einsum("ij,ij->i", d, n[owner])
    s = np.einsum("ij,ij->i", d, t[owner])
    sum_w, chi2 = total(weight), total(weight * residual**2)
    # Noise larger than told (a rough wall, another surface) widens the covariance instead of being believed.
    scale = np.maximum(1.0, chi2 / np.maximum(count - 2, 1))
    centre = np.einsum("ij,ij->i", mean, t)
    sum_ss = total(weight * s**2)
    var_alpha = scale / sum_ss
    var_r = scale / sum_w + centre**2 * var_alpha
    covariance = np.empty((len(start), 2, 2))
    covariance[:, 0, 0] = var_alpha + params.line_angle_floor**2
    covariance[:, 1, 1] = var_r + params.line_offset_floor**2 + (centre * params.line_angle_floor) ** 2
    covariance[:, 0, 1] = covariance[:, 1, 0] = centre * (var_alpha + params.line_angle_floor**2)
    share = weight**2 * by_angle
    angular = np.stack([total(share * s**2) / sum_ss**2, total(share) / sum_w**2], axis=1) * scale[:, None]
    r = np.einsum("ij,ij->i", mean, n)
    low = np.minimum.reduceat(s, first) if len(first) else np.zeros(0)
    high = np.maximum.reduceat(s, first) if len(first) else np.zeros(0)
    extents = np.stack([centre + low, centre + high], axis=1)
    keep = (high - low >= params.min_length) & (chi2 < 9.0 * count)
    segments = Segments(points.scan[start], np.stack([alpha, r], axis=1), covariance, extents, count, angular)
    return take(segments, keep)
