"""What moves in the scans: points where other scans saw that nothing is.

A person who walks along with the robot looks like a place that the robot does not leave. Bare walls do not
contradict that; but beams of earlier and later scans that passed where the person stands do.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d
from scipy.spatial import cKDTree

from bsmap_cli.core import se2
from bsmap_cli.model import Array, IntArray, LaserScans
from bsmap_cli.slam.matching import OrientedPoints

VIEWS = 4
"""Key scans before one with which it is compared, either way."""
ASIDE, SHORT = 0.03, 0.4
"""Radians to each side of a beam, and metres before its end, that count as free no more: poses and edges are not exact.
"""
STRIDE, SUPPORT = 0.5, 0.15
"""Metres that what moves goes on from key scan to key scan; within which points of other scans show that it stands."""
MOST = 0.5
"""Share of a scan's points that move beyond which its pose is doubted instead."""


class _View(NamedTuple):
    """A key scan: its points in map, a spatial index of them, and which of them move.

    through, standing : (k,) of the other key scans, how many saw through each point, and, of those seen through, how
    many saw one there.  laser : (3,) its pose.  free : (m,), see `free_ranges`.
    """

    xy: Array
    tree: cKDTree
    moves: NDArray[np.bool_]
    through: IntArray
    standing: IntArray
    laser: Array
    free: Array


class Watch:
    """Tells of key scans, as they come, which of their points move."""

    def __init__(self, scans: LaserScans) -> None:
        self._scans, self._mount = scans, se2.from_matrix(scans.mount)
        self._views: list[_View] = []

    def add(self, scan: int, pose: Array, placed: OrientedPoints, sure: bool) -> NDArray[np.bool_]:
        """(k,) points of `scan` at `pose` (3,), `placed` there, that move; it changes as later scans come.

        sure : whether the pose is; otherwise nothing is told by it, and nothing of it.
        """
        count = len(placed.xy)
        moves = np.zeros(count, bool)
        if not sure or not count:
            return moves
        free = free_ranges(self._scans.ranges[scan], self._scans.angle_increment)
        laser = se2.compose(pose, self._mount)
        view = _View(placed.xy, cKDTree(placed.xy), moves, np.zeros(count, int), np.zeros(count, int), laser, free)
        for other in self._views:
            self._compare(view, other)
            self._compare(other, view)
        self._follow(view)
        self._views = [*self._views[1 - VIEWS :], view]
        return moves

    def _compare(self, view: _View, other: _View) -> None:
        """Which points of `view` another scan sees through, and which of these it sees: they move unless more see them.

        What shows from one side only (a table's edge, glass) is seen through too, but stands where it was seen.
        """
        through = self._seen_through(view.xy, other)
        if through.mean() > MOST:
            return
        view.through[through] += 1
        doubted = np.flatnonzero(view.through)
        if len(doubted):
            nearest = other.tree.query(view.xy[doubted], distance_upper_bound=SUPPORT)[1]
            stands = np.append(~other.moves, False)[nearest]
            view.standing[doubted[stands]] += 1
            view.moves[doubted] = view.through[doubted] >= view.standing[doubted]

    def _follow(self, view: _View) -> None:
        """Points a stride from those of the last scan that move do so too, unless others show what stands there.

        Whoever walks ahead is seen through by later scans alone.
        """
        before = self._views[-1:]
        gone = [other.xy[other.moves & (other.through > 0)] for other in before]
        if not gone or not len(gone[0]):
            return
        near = np.flatnonzero(np.isfinite(cKDTree(gone[0]).query(view.xy, distance_upper_bound=STRIDE)[0]))
        standing = np.concatenate([other.xy[~other.moves] for other in self._views])
        if len(near) and len(standing):
            alone = ~np.isfinite(cKDTree(standing).query(view.xy[near], distance_upper_bound=SUPPORT)[0])
            view.moves[near[alone]] = True

    def _seen_through(self, xy: Array, view: _View) -> NDArray[np.bool_]:
        """(n,) whether points (n, 2) in map lie where beams of a scan passed."""
        x, y = xy[:, 0] - view.laser[0], xy[:, 1] - view.laser[1]
        beam = se2.wrap(np.arctan2(y, x) - view.laser[2] - self._scans.angle_min) / self._scans.angle_increment
        turn = 2 * np.pi / abs(self._scans.angle_increment)
        beam = np.rint(np.where(beam < -0.5, beam + turn, beam)).astype(int)
        inside = beam < len(view.free)
        return inside & (np.hypot(x, y) < view.free[np.where(inside, beam, 0)])


def free_ranges(ranges: NDArray[np.float32], increment: float) -> Array:
    """(m,) metres along each beam, and beside it, where there was nothing for sure; 0 where nothing returned."""
    aside = int(np.ceil(ASIDE / abs(increment)))
    return np.asarray(minimum_filter1d(np.nan_to_num(ranges), 2 * aside + 1), dtype=np.float64) - SHORT
