"""What key scans saw through: whether a place contradicts a scan, or was only never seen before."""

import cmath
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.table import take
from bsmap_cli.model import Array, LaserScans
from bsmap_cli.slam.matching import (
    LEAST_REACH,
    SAME_WAY,
    Match,
    OrientedPoints,
    Target,
    as_complex,
    least_width,
    make_target,
    nearest_points,
)

ASIDE, SHORT = 0.03, 0.4
"""Radians to each side of a beam, and metres before its end, that count as free no more: poses and edges are not exact.
"""
KEPT = 1000
"""Scans whose free ranges are kept, for places are looked at many times."""
LEAST_KNOWN = 0.3
"""Share of a scan's points on the map below which too little speaks for a place, whatever else could be seen."""


class View(NamedTuple):
    """A scan at a place in map.

    laser : its place, as a complex number.  turn : the conjugate of its direction.  ranges : (m + 1,) metres, 0 where
    nothing returned, and for the directions without a beam.  free : (m + 1,) metres that are free for sure.
    """

    laser: complex
    turn: complex
    ranges: Array
    free: Array


class Views:
    """Makes views of the scans of one laser, and asks them."""

    def __init__(self, scans: LaserScans) -> None:
        self._scans, self._mount = scans, se2.from_matrix(scans.mount)
        self._ranges = lru_cache(KEPT)(self._ranges_of)

    def view(self, scan: int, pose: Array) -> View:
        """Of a scan with base_link at `pose` (3,)."""
        x, y, theta = se2.compose(pose, self._mount).tolist()
        return View(complex(x, y), cmath.exp(-1j * theta), *self._ranges(scan))

    def _ranges_of(self, scan: int) -> tuple[Array, Array]:
        """Ranges and free ranges of a view."""
        ranges = np.nan_to_num(np.append(self._scans.ranges[scan], 0.0))
        return ranges, free_ranges(ranges, self._scans.angle_increment)

    def through(self, at: NDArray[np.complex128], views: list[View]) -> NDArray[np.bool_]:
        """(v, n) whether points (n,) in map, as complex numbers, lie where beams of the scans passed."""
        if not views:
            return np.zeros((0, len(at)), bool)
        away, beam = self._beams(at, views)
        return np.abs(away) < np.take_along_axis(np.array([view.free for view in views]), beam, axis=1)

    def ends(self, at: NDArray[np.complex128], views: list[View]) -> NDArray[np.bool_]:
        """(v, n) whether points (n,) in map lie about where the beams of the scans ended."""
        away, beam = self._beams(at, views)
        ranges = np.take_along_axis(np.array([view.ranges for view in views]), beam, axis=1)
        return np.abs(np.abs(away) - ranges) <= SHORT

    def _beams(self, at: NDArray[np.complex128], views: list[View]) -> tuple[NDArray[np.complex128], NDArray[np.int_]]:
        """Points (v, n) in the frames of the scans, and the beam that passes each; the last one where none does."""
        laser, turn = np.array([[view.laser, view.turn] for view in views]).T[..., None]
        away = (at - laser) * turn
        increment = self._scans.angle_increment
        beam = np.rint((np.angle(away) - self._scans.angle_min) / increment).astype(int)
        beam[beam < 0] += round(2 * np.pi / abs(increment))
        return away, np.minimum(beam, len(views[0].free) - 1)


def free_ranges(ranges: Array, increment: float) -> Array:
    """(m,) metres along each beam, and beside it, where there was nothing for sure; none where `ranges` (m,) are 0."""
    aside = int(np.ceil(ASIDE / abs(increment)))
    least = ranges.copy()
    for step in range(1, aside + 1):
        for some, other in ((slice(step, None), slice(None, -step)), (slice(None, -step), slice(step, None))):
            np.minimum(least[some], ranges[other], out=least[some])
    return least - SHORT


class LocalMap(NamedTuple):
    """target : points of the last key scans, to be matched against.  seen : their views, of those that are sure."""

    target: Target
    seen: list[View]
    views: Views


def agreeing(found: Match, scan: int, points: OrientedPoints, local: LocalMap, noise: float) -> float:
    """Share of what scan and map both could see on which they agree, with the `points` of the scan as `found`.

    Who turns into a room or drives backwards sees much that nobody saw before: this contradicts nothing. But where
    beams of others passed there is nothing to be seen, and where the scan's pass there can be nothing of the map. The
    lesser one of the two shares counts.
    """
    moved = points.moved(found.pose)
    on = _on(moved, local.target, noise)
    known = int(np.count_nonzero(on))
    if known <= LEAST_KNOWN * len(on):
        return found.inliers
    denied = int(local.views.through(as_complex(moved.xy)[~on], local.seen).any(axis=0).sum())
    view = [local.views.view(scan, found.pose)]
    at = as_complex(local.target.points.xy)
    gone, there = int(local.views.through(at, view).sum()), int(local.views.ends(at, view).sum())
    return min(known / (known + denied), there / max(there + gone, 1))


class Visit(NamedTuple):
    """What key scans saw of a place: their points and their views, in one frame."""

    points: OrientedPoints
    seen: list[View]


def contradicting(one: Visit, other: Visit, views: Views, noise: float) -> float:
    """Larger share of the points of either visit, of those that the other one could see, where it saw through."""
    shares = []
    for these, those in ((one, other), (other, one)):
        on = _on(these.points, make_target(those.points), noise)
        denied = int(views.through(as_complex(these.points.xy)[~on], those.seen).any(axis=0).sum())
        shares.append(denied / max(denied + int(np.count_nonzero(on)), 1))
    return max(shares)


def _on(points: OrientedPoints, target: Target, noise: float) -> NDArray[np.bool_]:
    """(n,) whether points lie on lines of the target that face their way."""
    distance, nearest = nearest_points(target, points.xy, LEAST_REACH)
    paired = np.flatnonzero(np.isfinite(distance))
    there, here = take(target.points, nearest[paired]), take(points, paired)
    near = np.abs(np.einsum("ij,ij->i", there.normal, here.xy - there.xy)) < least_width(noise)
    on = np.zeros(len(distance), bool)
    on[paired] = near & (np.einsum("ij,ij->i", there.normal, here.normal) > SAME_WAY)
    return on
