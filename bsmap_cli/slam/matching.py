"""Scan matching: points of a scan on the points and normals of a map, point to line, robust, with a prior.

Censi (2008) for the metric, with a Cauchy loss whose width shrinks from the reach of the search to the noise.
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dposv
from scipy.spatial import cKDTree

from bsmap_cli.core import se2
from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.segments import ScanPoints

NORMAL_REACH = 0.12
"""Metres to each side over which a point's normal is fitted."""


SEARCH_POINTS = 70
SEARCH_STEP, SEARCH_STEPS, SEARCH_ANGLE = 0.3, 8, 0.12
"""Points looked at; steps of the grid of starts in metres and radians, wider where too many would be needed."""
LEAST_REACH = 0.15
"""Metres within which points pair in the end."""
SAME_WAY = 0.7
"""Cosine of the angle between normals above which two points can be of one surface."""


class OrientedPoints(NamedTuple):
    """xy : (n, 2), metres.  normal : (n, 2), unit, towards the laser that saw the point."""

    xy: Array
    normal: Array

    def moved(self, pose: Array) -> "OrientedPoints":
        """In the frame in which `pose` (3,), or poses that broadcast (..., 1, 3), are given."""
        turn = pose * [0.0, 0.0, 1.0]
        return OrientedPoints(se2.transform(pose, self.xy), se2.transform(turn, self.normal))


class Target(NamedTuple):
    """Map to match against: its points, a spatial index of them, and their lines.

    lines : (n + 1, 3), normal and offset of each; the last one, 0, stands for no point.
    """

    points: OrientedPoints
    tree: cKDTree
    lines: Array


class Match(NamedTuple):
    """pose : (3,), of the scan in the map's frame.  information : (3, 3) of the match alone, without the prior.

    inliers : share of the scan's points that lie on the map.  rms : metres, of the inliers.
    """

    pose: Array
    information: Array
    inliers: float
    rms: float


def make_target(points: OrientedPoints) -> Target:
    """Target of points given in one frame."""
    lines = np.zeros((len(points.xy) + 1, 3))
    lines[:-1, :2] = points.normal
    lines[:-1, 2] = np.einsum("ij,ij->i", points.xy, points.normal)
    return Target(points, cKDTree(points.xy, balanced_tree=False, compact_nodes=False), lines)


def nearest_points(target: Target, xy: Array, reach: float) -> tuple[Array, IntArray]:
    """Distances (k,) and indices (k,) of the target's points nearest to `xy` (k, 2); infinite and n beyond `reach`."""
    distance, index = target.tree.query(xy, distance_upper_bound=reach)
    return np.asarray(distance), np.asarray(index)


def oriented_points(points: ScanPoints, laser_xy: Array, range_sigma: float) -> tuple[OrientedPoints, IntArray]:
    """Points whose normal is well known, and which ones of `points` they are.

    The normal is that of the best line through neighbouring points of one surface, by running sums of moments.
    """
    n = len(points.scan)
    near = np.hypot(*np.diff(points.xy, axis=0).T)
    step = np.median(np.diff(points.angle)[np.diff(points.beam) == 1]) if n > 1 else 0.0
    jump = (near > 0.15 + 6 * np.abs(step) * points.range[:-1]) | (np.diff(points.scan) != 0)
    group = np.r_[0, np.cumsum(jump)]
    first = np.searchsorted(group, group, "left")
    last = np.searchsorted(group, group, "right")
    half = np.clip(np.rint(NORMAL_REACH / np.maximum(points.range * abs(step), 1e-4)), 2, 12).astype(int)
    index = np.arange(n)
    half = np.minimum(half, np.maximum(np.minimum(index - first, last - 1 - index), 1))
    low, high = np.maximum(index - half, first), np.minimum(index + half + 1, last)
    x, y = points.xy[:, 0], points.xy[:, 1]
    sums = np.zeros((n + 1, 5))
    np.cumsum(np.stack([x, y, x * x, x * y, y * y], axis=1), axis=0, out=sums[1:])
    count = high - low
    m = (sums[high] - sums[low]) / np.maximum(count, 1)[:, None]
    xx, xy, yy = m[:, 2] - m[:, 0] ** 2, m[:, 3] - m[:, 0] * m[:, 1], m[:, 4] - m[:, 1] ** 2
    angle = 0.5 * np.arctan2(2 * xy, xx - yy)
    normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
    spread = np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    across, along = (xx + yy) / 2 - spread, (xx + yy) / 2 + spread
    away = np.einsum("ij,ij->i", normal, points.xy - laser_xy) > 0
    normal[away] *= -1
    good = (count >= 3) & (across < 0.15 * along) & (across < (5 * range_sigma) ** 2)
    return OrientedPoints(points.xy[good], normal[good]), np.flatnonzero(good)


class _Pairs(NamedTuple):
    """Points paired from one pose, the closer ones within `reach` metres.

    xy : (2, k) of the source, in its frame.  normal : (2, k), offset : (k,), of the lines of the target.
    distance : (k,) metres between the two.
    """

    pose: Array
    reach: float
    xy: Array
    normal: Array
    offset: Array
    distance: Array

    def within(self, reach: float) -> "_Pairs":
        """The pairs that are closer than `reach`."""
        near = self.distance < reach
        return _Pairs(self.pose, reach, self.xy[:, near], self.normal[:, near], self.offset[near], self.distance[near])


def match(
    source: OrientedPoints,
    target: Target,
    initial: Array,
    prior: Array,
    range_sigma: float,
    reach: float = 0.5,
    iterations: int = 25,
) -> Match:
    """Best pose of `source` on `target`, Gauss-Newton from `initial` (3,).

    prior : (3, 3) information of the initial pose, in the target's frame; what the points do not tell stays there.
    reach : metres within which points can pair at first.
    """
    pose = initial.copy()
    floor = max(2 * range_sigma, 0.05)
    pairs = None
    for _ in range(iterations):
        if pairs is None or _has_moved(pairs.pose, pose):
            pairs = _pair(source, target, pose, reach)
        elif reach < pairs.reach:
            pairs = pairs.within(reach)
        if len(pairs.offset) < 5:
            return Match(initial, np.zeros((3, 3)), 0.0, 0.0)
        moments, e = _moments(pairs, pose, max(floor, reach / 4))
        information = moments[:3, :3] / range_sigma**2
        away = pose - initial
        away[2] = se2.wrap(away[2])
        step = dposv(information + prior, -moments[:3, 3] / range_sigma**2 - prior @ away)[1]
        pose += step
        x, y, theta = step.tolist()
        if reach <= LEAST_REACH and abs(x) + abs(y) < 1e-3 and abs(theta) < 5e-4:
            break
        reach = max(LEAST_REACH, reach * 0.5)
    on = np.abs(e) < floor
    pose[2] = se2.wrap(pose[2])
    rms = float(np.sqrt(np.mean(e[on] ** 2))) if on.any() else 0.0
    return Match(pose, information, np.count_nonzero(on) / max(len(source.xy), 1), rms)


def _moments(pairs: _Pairs, pose: Array, width: float) -> tuple[Array, Array]:
    """(4, 4) weighted sums of products of the derivatives by x, y, theta and of the errors; the errors (k,), metres.

    Weights of the Cauchy loss, `width` metres wide.
    """
    (nx, ny), turned = pairs.normal, _turn(pose[2]) @ pairs.xy
    A = np.empty((4, len(pairs.offset)))
    A[:2] = pairs.normal
    np.subtract(ny * turned[0], nx * turned[1], out=A[2])
    A[3] = nx * (turned[0] + pose[0]) + ny * (turned[1] + pose[1]) - pairs.offset
    return (A / (1.0 + (A[3] / width) ** 2)) @ A.T, A[3]


def _turn(theta: float) -> Array:
    """(2, 2) rotation by theta."""
    c, s = math.cos(theta), math.sin(theta)
    return np.array([[c, -s], [s, c]])


def _has_moved(before: Array, pose: Array) -> bool:
    """Whether points may have other partners now than where they were paired."""
    x, y, theta = (pose - before).tolist()
    return abs(x) + abs(y) > 0.02 or abs(theta) > 0.006


def _pair(source: OrientedPoints, target: Target, pose: Array, reach: float) -> _Pairs:
    """Each point of the source, at `pose` (3,), with the nearest of the target that faces its way."""
    R = _turn(pose[2]).T
    distance, nearest = nearest_points(target, source.xy @ R + pose[:2], reach)
    lines, facing = target.lines[nearest], source.normal @ R
    same = np.flatnonzero(lines[:, 0] * facing[:, 0] + lines[:, 1] * facing[:, 1] > SAME_WAY)
    lines = lines[same].T
    return _Pairs(pose.copy(), reach, source.xy[same].T, lines[:2], lines[2], distance[same])


def search(
    source: OrientedPoints, target: Target, initial: Array, span: float, turn: float, best: int = 3
) -> list[Array]:
    """Best poses on a grid of starts about `initial`: within `span` metres and `turn` radians, nearest first of equals.

    Each start is judged by how many of some points of the source lie near points of the target that face their way.
    """
    if len(source.xy) == 0:
        return [initial]  # nothing tells one place from another
    thin = slice(None, None, max(1, len(source.xy) // SEARCH_POINTS))
    points = OrientedPoints(source.xy[thin], source.normal[thin])
    step = max(SEARCH_STEP, span / SEARCH_STEPS)
    sigma = 0.8 * step
    angles = initial[2] + _centred(turn, SEARCH_ANGLE)
    shifts = np.stack(np.meshgrid(_centred(span, step), _centred(span, step)), axis=-1).reshape(-1, 2)
    turned = points.moved(np.stack([0 * angles, 0 * angles, angles], axis=-1)[:, None])
    places = turned.xy[:, None] + initial[:2] + shifts[None, :, None]
    normals = np.broadcast_to(turned.normal[:, None], places.shape).reshape(-1, 2)
    distance, nearest = nearest_points(target, places.reshape(-1, 2), 3 * sigma)
    near = np.flatnonzero(np.isfinite(distance))
    near = near[np.einsum("ij,ij->i", target.points.normal[nearest[near]], normals[near]) > SAME_WAY]
    score = np.zeros(len(distance))
    score[near] = np.exp(-0.5 * (distance[near] / sigma) ** 2)
    order = np.argsort(-score.reshape(len(angles) * len(shifts), -1).mean(axis=1), kind="stable")[:best]
    return [np.array([*(initial[:2] + shifts[k % len(shifts)]), angles[k // len(shifts)]]) for k in order]


def _centred(reach: float, step: float) -> Array:
    """Values from -reach to reach in steps about 0, by distance from 0."""
    count = int(np.floor(reach / step + 1e-9))
    values = step * np.arange(-count, count + 1, dtype=np.float64)
    return values[np.argsort(np.abs(values), kind="stable")]
