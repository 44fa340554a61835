"""What moves in the scans: points where other scans saw that nothing is.

A person who walks along with the robot looks like a place that the robot does not leave. Bare walls do not
contradict that; but beams of earlier and later scans that passed where the person stands do.
"""

import cmath
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bsmap_cli.core import se2
from bsmap_cli.model import Array, LaserScans
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


class _View:
    """A key scan: its points (k,) in map, as complex numbers, and which of them move.

    through, standing : (k,) of the other key scans, how many saw through each point, and, of those seen through, how
    many saw one there.  laser : its place.  turn : the conjugate of its direction.  free : (m + 1,), see `free_ranges`.
    """

    def __init__(self, xy: Array, laser: Array, free: Array) -> None:
        self.at = xy[:, 0] + 1j * xy[:, 1]
        self.laser, self.turn, self.free = complex(laser[0], laser[1]), cmath.exp(-1j * laser[2]), free
        self.moves = np.zeros(len(xy), bool)
        self.through, self.standing = np.zeros((2, len(xy)), int)

    @cached_property
    def tree(self) -> cKDTree:
        """Spatial index of the points: few scans need it."""
        return cKDTree(_xy(self.at))

    def shows(self, at: NDArray[np.complex128]) -> NDArray[np.bool_]:
        """(n,) whether the nearest point of this scan is at the points (n,), and does not move."""
        return np.append(~self.moves, False)[self.tree.query(_xy(at), distance_upper_bound=SUPPORT)[1]]


class Watch:
    """Tells of key scans, as they come, which of their points move."""

    def __init__(self, scans: LaserScans) -> None:
        self._scans, self._mount = scans, se2.from_matrix(scans.mount)
        self._views: list[_View] = []

    def add(self, scan: int, pose: Array, placed: OrientedPoints, sure: bool) -> NDArray[np.bool_]:
        """(k,) points of `scan` at `pose` (3,), `placed` there, that move; it changes as later scans come.

        sure : whether the pose is; otherwise nothing is told by it, and nothing of it.
        """
        if not sure or not len(placed.xy):
            return np.zeros(len(placed.xy), bool)
        free = free_ranges(self._scans.ranges[scan], self._scans.angle_increment)
        view = _View(placed.xy, se2.compose(pose, self._mount), free)
        if self._views:
            self._look_at(view)
            self._follow(view)
        self._views = [*self._views[1 - VIEWS :], view]
        return view.moves

    def _look_at(self, view: _View) -> None:
        """What the new scan and the others see through of each other."""
        border = np.cumsum([len(other.at) for other in self._views[:-1]])
        through = self._seen_through(np.concatenate([other.at for other in self._views]), [view])[0]
        ahead = self._seen_through(view.at, self._views)
        for other, there, back in zip(self._views, ahead, np.split(through, border), strict=True):
            self._count(view, other, there)
            self._count(other, view, back)

    def _count(self, view: _View, other: _View, through: NDArray[np.bool_]) -> None:
        """Points of `view` that the other scan sees `through` move, unless more others see one there.

        What shows from one side only (a table's edge, glass) is seen through too, but stands where it was seen.
        """
        if np.count_nonzero(through) > MOST * len(through):
            return
        view.through += through
        doubted = np.flatnonzero(view.through)
        if len(doubted):
            view.standing[doubted] += other.shows(view.at[doubted])
            view.moves[doubted] = view.through[doubted] >= view.standing[doubted]

    def _follow(self, view: _View) -> None:
        """Points a stride from those of the last scan that move do so too, unless others show what stands there.

        Whoever walks ahead is seen through by later scans alone.
        """
        last = self._views[-1]
        gone = last.at[last.moves & (last.through > 0)]
        standing = np.concatenate([other.at[~other.moves] for other in self._views])
        if not len(gone) or not len(standing):
            return
        near = np.flatnonzero(_near(view.at, cKDTree(_xy(gone)), STRIDE))
        view.moves[near[~_near(view.at[near], cKDTree(_xy(standing)), SUPPORT)]] = True

    def _seen_through(self, at: NDArray[np.complex128], views: list[_View]) -> NDArray[np.bool_]:
        """(v, n) whether points (n,) in map, as complex numbers, lie where beams of the scans passed."""
        laser, turn = np.array([[view.laser, view.turn] for view in views]).T[..., None]
        away = (at - laser) * turn
        increment = self._scans.angle_increment
        beam = np.rint((np.angle(away) - self._scans.angle_min) / increment).astype(int)
        beam[beam < 0] += round(2 * np.pi / abs(increment))
        free = np.array([view.free for view in views])
        return np.abs(away) < np.take_along_axis(free, np.minimum(beam, free.shape[1] - 1), axis=1)


def free_ranges(ranges: NDArray[np.float32], increment: float) -> Array:
    """(m + 1,) metres along each beam, and beside it, where there was nothing for sure; none where nothing returned.

    The last one stands for all directions without a beam.
    """
    aside = int(np.ceil(ASIDE / abs(increment)))
    known = np.nan_to_num(np.append(ranges, 0.0))
    least = known.copy()
    for step in range(1, aside + 1):
        for some, other in ((slice(step, None), slice(None, -step)), (slice(None, -step), slice(step, None))):
            np.minimum(least[some], known[other], out=least[some])
    return least - SHORT


def _xy(at: NDArray[np.complex128]) -> Array:
    return np.column_stack([at.real, at.imag])


def _near(at: NDArray[np.complex128], tree: cKDTree, reach: float) -> NDArray[np.bool_]:
    """(n,) whether points (n,) have one of the tree within reach."""
    return np.isfinite(tree.query(_xy(at), distance_upper_bound=reach)[0])
