"""Scan matching: points of a scan on the points and normals of a map, point to line, robust, with a prior.

Censi (2008) for the metric, with a Cauchy loss whose width shrinks from the reach of the search to the noise.
"""

import cmath
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bsmap_cli.core.three import solve_three
from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.segments import ScanPoints

NORMAL_REACH = 0.12
"""Metres to each side over which a point's normal is fitted."""
NORMAL_SIGMA = 0.2
"""Radians, standard deviation of a normal by the noise of the points beyond which it tells nothing."""


SEARCH_POINTS = 70
SEARCH_STEP, SEARCH_STEPS, SEARCH_ANGLE, SEARCH_CELLS = 0.3, 8, 0.12, 6
"""Points looked at; steps of the grid of starts in metres and radians, wider where too many would be needed; cells of
a step within which all points have the same nearest one."""
LEAST_REACH = 0.15
"""Metres within which points pair in the end."""
_FACTORS = np.array([[1.0, 0, 0, 0, 0, 0], [0, 1.0, 0, 0, 0, 0], [0, 0, 0, 0, 0, 0], [0, 0, 0, 0, -1.0, 0]])
"""Of the terms of a pair in the derivatives of its error and in the error, where the pose does not change them."""
SAME_WAY = 0.7
"""Cosine of the angle between normals above which two points can be of one surface."""


Floats = tuple[float, float, float]
"""A pose x, y, theta where numpy costs more than it does."""


class OrientedPoints(NamedTuple):
    """xy : (n, 2), metres.  normal : (n, 2), unit, towards the laser that saw the point."""

    xy: Array
    normal: Array

    def moved(self, pose: Array) -> "OrientedPoints":
        """In the frame in which the pose (3,) is given."""
        R = _row_rotation(float(pose[2]))
        return OrientedPoints(self.xy @ R + pose[:2], self.normal @ R)

    def moved_each(self, poses: Array, owner: IntArray) -> "OrientedPoints":
        """Each point by the pose, of these (k, 3), that `owner` (n,) tells."""
        c, s = np.cos(poses[:, 2])[owner], np.sin(poses[:, 2])[owner]
        xy, normal = np.empty((len(owner), 2)), np.empty((len(owner), 2))
        for out, (x, y) in ((xy, self.xy.T), (normal, self.normal.T)):
            out[:, 0], out[:, 1] = c * x - s * y, s * x + c * y
        xy += poses[owner, :2]
        return OrientedPoints(xy, normal)


def _row_rotation(theta: float) -> Array:
    """(2, 2) R with which points in rows are turned by theta: xy @ R."""
    c, s = math.cos(theta), math.sin(theta)
    return np.array([[c, s], [-s, c]])


class Target(NamedTuple):
    """Map to match against: its points, a spatial index of them, and their lines.

    normals : (n + 1,) of the lines, as complex numbers; the last one, 0, stands for no point.  offsets : (n + 1,).
    """

    points: OrientedPoints
    tree: cKDTree
    normals: NDArray[np.complex128]
    offsets: Array


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
    normals, offsets = np.zeros(len(points.xy) + 1, np.complex128), np.zeros(len(points.xy) + 1)
    normals[:-1] = as_complex(points.normal)
    offsets[:-1] = np.einsum("ij,ij->i", points.xy, points.normal)
    tree = cKDTree(points.xy, leafsize=32, balanced_tree=False, compact_nodes=False)
    return Target(points, tree, normals, offsets)


def as_complex(vectors: Array) -> NDArray[np.complex128]:
    """Vectors (n, 2) as complex numbers (n,): turning them is a product, and takes one call."""
    return vectors.view(np.complex128)[:, 0]


def nearest_points(target: Target, xy: Array, reach: float) -> tuple[Array, IntArray]:
    """Distances (k,) and indices (k,) of the target's points nearest to `xy` (k, 2); infinite and n beyond `reach`."""
    distance, index = target.tree.query(xy, distance_upper_bound=reach)
    return np.asarray(distance), np.asarray(index)


def oriented_points(points: ScanPoints, laser_xy: Array, range_sigma: float) -> tuple[OrientedPoints, IntArray]:
    """Points whose normal is well known, and which ones of `points` they are.

    The normal is that of the best line through neighbouring points of one surface, by running sums of moments.
    """
    n = len(points.scan)
    if n == 0:
        return OrientedPoints(points.xy, points.direction), np.zeros(0, int)
    x, y = np.ascontiguousarray(points.xy.T)
    step = abs(float(np.median(np.diff(points.angle)[np.diff(points.beam) == 1]))) if n > 1 else 0.0
    apart = np.diff(x) ** 2 + np.diff(y) ** 2
    jump = (apart > (0.15 + 6 * step * points.range[:-1]) ** 2) | (np.diff(points.scan) != 0)
    border = np.concatenate([[0], np.flatnonzero(jump) + 1, [n]])
    first, last = (np.repeat(border[k : len(border) - 1 + k], np.diff(border)) for k in (0, 1))
    half = np.rint(NORMAL_REACH / np.maximum(points.range * step, 1e-4)).clip(2, 12).astype(int)
    index = np.arange(n)
    low, high = np.maximum(index - half, first), np.minimum(index + half + 1, last)
    sums = np.zeros((5, n + 1))
    np.cumsum([x, y, x * x, x * y, y * y], axis=1, out=sums[:, 1:])
    mx, my, xx, xy, yy = (np.take(sums, high, axis=1) - np.take(sums, low, axis=1)) / (high - low)
    xx, xy, yy = xx - mx * mx, xy - mx * my, yy - my * my
    middle, half_difference = (xx + yy) / 2, (xx - yy) / 2
    spread = np.sqrt(half_difference**2 + xy**2)
    across, along = middle - spread, middle + spread
    count = high - low
    straight = (across < 0.15 * along) & (across < (5 * range_sigma) ** 2)
    good = np.flatnonzero((count >= 3) & straight & (count * along > (range_sigma / NORMAL_SIGMA) ** 2))
    at, normal = points.xy[good], _normals(half_difference[good], xy[good], spread[good])
    normal[np.einsum("ij,ij->i", normal, at - laser_xy) > 0] *= -1
    return OrientedPoints(at, normal), good


def _normals(half_difference: Array, xy: Array, spread: Array) -> Array:
    """(n, 2) unit normals of the lines along which points scatter.

    half_difference : (n,) of the moments xx and yy.  xy : (n,).  spread : (n,) root of both squared, not 0.
    """
    large = np.sqrt(0.5 + np.abs(half_difference) / (2 * spread))  # the larger one of the direction's cosine and sine
    small, sign = np.abs(xy) / (2 * spread * large), np.where(xy < 0, -1.0, 1.0)
    level = half_difference >= 0
    return np.stack([-sign * np.where(level, small, large), np.where(level, large, small)], axis=1)


class _Pairs(NamedTuple):
    """Points paired from one pose, the closer ones within `reach` metres.

    terms : (k, 6) of each pair's error, see `_moments`.  distance : (k,) metres between the two.
    """

    pose: Floats
    reach: float
    terms: Array
    distance: Array

    def within(self, reach: float) -> "_Pairs":
        """The pairs that are closer than `reach`."""
        near = np.flatnonzero(self.distance < reach)
        return _Pairs(self.pose, reach, self.terms[near], self.distance[near])


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
    start: Floats = tuple(initial.tolist())
    pose, known = start, prior.tolist()
    floor = least_width(range_sigma)
    pairs = None
    for _ in range(iterations):
        if pairs is None or _has_moved(pairs.pose, pose):
            pairs = _pair(source, target, pose, reach)
        elif reach < pairs.reach:
            pairs = pairs.within(reach)
        if len(pairs.distance) < 5:
            return Match(initial, np.zeros((3, 3)), 0.0, 0.0)
        moments, e = _moments(pairs, pose, max(floor, reach / 4), range_sigma)
        x, y, theta = _step(moments.tolist(), known, (pose[0] - start[0], pose[1] - start[1], pose[2] - start[2]))
        pose = (pose[0] + x, pose[1] + y, pose[2] + theta)
        if reach <= LEAST_REACH and abs(x) + abs(y) < 1e-3 and abs(theta) < 5e-4:
            break
        reach = max(LEAST_REACH, reach * 0.5)
    on = e[np.abs(e) < floor]
    rms = math.sqrt(float(on @ on) / len(on)) if len(on) else 0.0
    wrapped = np.array([pose[0], pose[1], math.remainder(pose[2], math.tau)])
    return Match(wrapped, moments[:3, :3], len(on) / max(len(source.xy), 1), rms)


def least_width(sigma: float) -> float:
    """Metres off a line within which a point is on it; sigma: of its distance."""
    return max(2 * sigma, 0.05)


def _moments(pairs: _Pairs, pose: Floats, width: float, sigma: float) -> tuple[Array, Array]:
    """(4, 4) weighted sums of products of the derivatives by x, y, theta and of the errors; the errors (k,), metres.

    A point p of the source errs from the line with normal n and offset r by n . (R p + t) - r, which is linear in the
    terms n, n . p, n x p and r (and 0 at the end) with factors that the pose alone gives. Weights of the Cauchy loss,
    `width` metres wide, over sigma squared.
    """
    x, y, theta = pose
    c, s = math.cos(theta), math.sin(theta)
    factors = _FACTORS.copy()
    factors[2, 2:4] = -s, -c
    factors[3, :4] = x, y, c, -s
    A = factors @ pairs.terms.T
    spread = A[3] * (sigma / width)
    spread *= spread
    spread += sigma**2
    return (A / spread) @ A.T, A[3]


def _step(moments: list[list[float]], prior: list[list[float]], away: Floats) -> Floats:
    """Step of Gauss-Newton from the moments (4, 4) and from the prior (3, 3) of the pose that is `away`."""
    (a, b, c, u), (_, d, e, v), (_, _, f, w), _ = moments
    x, y, theta = away[0], away[1], math.remainder(away[2], math.tau)
    (pa, pb, pc), (_, pd, pe), (_, _, pf) = prior
    side = -u - pa * x - pb * y - pc * theta, -v - pb * x - pd * y - pe * theta, -w - pc * x - pe * y - pf * theta
    return solve_three((a + pa, b + pb, c + pc, d + pd, e + pe, f + pf), side)


def _has_moved(before: Floats, pose: Floats) -> bool:
    """Whether points may have other partners now than where they were paired."""
    return abs(pose[0] - before[0]) + abs(pose[1] - before[1]) > 0.02 or abs(pose[2] - before[2]) > 0.006


def _pair(source: OrientedPoints, target: Target, pose: Floats, reach: float) -> _Pairs:
    """Each point of the source, at the pose, with the nearest of the target that faces its way."""
    x, y, theta = pose
    turn = cmath.rect(1.0, theta)
    points = as_complex(source.xy)
    placed = points * turn
    placed += complex(x, y)
    distance, nearest = nearest_points(target, placed.view(np.float64).reshape(-1, 2), reach)
    normals = target.normals[nearest].conj()
    same = np.flatnonzero((normals * (as_complex(source.normal) * turn)).real > SAME_WAY)
    terms = np.empty((len(same), 3), np.complex128)
    normals = normals[same]
    terms[:, 0] = normals.conj()
    np.multiply(normals, points[same], out=terms[:, 1])
    terms[:, 2] = target.offsets[nearest[same]]
    return _Pairs(pose, reach, terms.view(np.float64), distance[same])


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
    angles = initial[2] + _centred(turn, SEARCH_ANGLE)
    shifts = np.stack(np.meshgrid(_centred(span, step), _centred(span, step)), axis=-1).reshape(-1, 2)
    turns = np.array([_row_rotation(angle) for angle in angles.tolist()])
    xy, normal = points.xy @ turns + initial[:2], points.normal @ turns
    score = _scores(target, xy, normal, np.rint(shifts / step).astype(int), step)
    order = np.argsort(-score.ravel(), kind="stable")[:best]
    return [np.array([*(initial[:2] + shifts[k % len(shifts)]), angles[k // len(shifts)]]) for k in order]


def _scores(target: Target, xy: Array, normal: Array, shifts: IntArray, step: float) -> Array:
    """(a, s) how well points (a, p, 2) with normals lie on the target when shifted by `shifts` (s, 2) steps.

    Points in one cell of a grid, SEARCH_CELLS a step, have one nearest point of the target, that of the cell's centre:
    many starts share a cell, and the target is asked for each one only once.
    """
    cell, sigma = step / SEARCH_CELLS, 0.8 * step
    at, moved = np.rint(xy / cell).astype(int), SEARCH_CELLS * shifts
    low = at.min(axis=(0, 1)) + moved.min(axis=0)
    width, height = at.max(axis=(0, 1)) + moved.max(axis=0) - low + 1
    strides = np.array([height, 1])
    index = ((at - low) @ strides)[:, None] + (moved @ strides)[:, None]
    seen = np.zeros(width * height, bool)
    seen[index] = True
    cells = np.flatnonzero(seen)
    number = np.empty(width * height, np.int32)  # of each cell that was seen
    number[cells] = np.arange(len(cells), dtype=np.int32)
    centres = cell * (np.stack(np.divmod(cells, height), axis=1) + low)
    distance, nearest = nearest_points(target, centres, 3 * sigma)
    score = np.exp(-0.5 * (distance / sigma) ** 2).astype(np.float32)
    normals, own = target.normals[nearest].astype(np.complex64), normal.astype(np.float32)[:, None]
    which = number[index]
    facing = normals.real[which] * own[..., 0]
    facing += normals.imag[which] * own[..., 1]
    worth = score[which]
    worth *= facing > SAME_WAY
    return np.asarray(worth.mean(axis=-1))


def _centred(reach: float, step: float) -> Array:
    """Values from -reach to reach in steps about 0, by distance from 0."""
    count = int(np.floor(reach / step + 1e-9))
    values = step * np.arange(-count, count + 1, dtype=np.float64)
    return values[np.argsort(np.abs(values), kind="stable")]
