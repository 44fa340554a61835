"""What moves in the scans: points where other scans saw that nothing is.

A person who walks along with the robot looks like a place that the robot does not leave. Bare walls do not
contradict that; but beams of earlier and later scans that passed where the person stands do.
"""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bsmap_cli.model import Array
from bsmap_cli.slam.matching import OrientedPoints, as_complex
from bsmap_cli.slam.visibility import View, Views

VIEWS = 4
"""Key scans before one with which it is compared, either way."""
STRIDE, SUPPORT = 0.5, 0.15
"""Metres that what moves goes on from key scan to key scan; within which points of other scans show that it stands."""
MOST = 0.5
"""Share of a scan's points that move beyond which its pose is doubted instead."""


class _Watched:
    """A key scan: its points (k,) in map, as complex numbers, and which of them move.

    through, standing : (k,) of the other key scans, how many saw through each point, and, of those seen through, how
    many saw one there.
    """

    def __init__(self, xy: Array, view: View) -> None:
        self.at, self.view = as_complex(xy), view
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

    def __init__(self, views: Views) -> None:
        self._views = views
        self._scans: list[_Watched] = []

    def add(self, view: View, placed: OrientedPoints, sure: bool) -> NDArray[np.bool_]:
        """(k,) points of a scan, `placed` where it was seen from, that move; it changes as later scans come.

        sure : whether the pose is; otherwise nothing is told by it, and nothing of it.
        """
        if not sure or not len(placed.xy):
            return np.zeros(len(placed.xy), bool)
        scan = _Watched(placed.xy, view)
        if self._scans:
            self._look_at(scan)
            self._follow(scan)
        self._scans = [*self._scans[1 - VIEWS :], scan]
        return scan.moves

    def _look_at(self, scan: _Watched) -> None:
        """What the new scan and the others see through of each other."""
        border = np.cumsum([len(other.at) for other in self._scans[:-1]])
        through = self._views.through(np.concatenate([other.at for other in self._scans]), [scan.view])[0]
        ahead = self._views.through(scan.at, [other.view for other in self._scans])
        for other, there, back in zip(self._scans, ahead, np.split(through, border), strict=True):
            self._count(scan, other, there)
            self._count(other, scan, back)

    def _count(self, scan: _Watched, other: _Watched, through: NDArray[np.bool_]) -> None:
        """Points of `scan` that the other scan sees `through` move, unless more others see one there.

        What shows from one side only (a table's edge, glass) is seen through too, but stands where it was seen.
        """
        if np.count_nonzero(through) > MOST * len(through):
            return
        scan.through += through
        doubted = np.flatnonzero(scan.through)
        if len(doubted):
            scan.standing[doubted] += other.shows(scan.at[doubted])
            scan.moves[doubted] = scan.through[doubted] >= scan.standing[doubted]

    def _follow(self, scan: _Watched) -> None:
        """Points a stride from those of the last scan that move do so too, unless others show what stands there.

        Whoever walks ahead is seen through by later scans alone.
        """
        last = self._scans[-1]
        gone = last.at[last.moves & (last.through > 0)]
        standing = np.concatenate([other.at[~other.moves] for other in self._scans])
        if not len(gone) or not len(standing):
            return
        near = np.flatnonzero(_near(scan.at, cKDTree(_xy(gone)), STRIDE))
        scan.moves[near[~_near(scan.at[near], cKDTree(_xy(standing)), SUPPORT)]] = True


def _xy(at: NDArray[np.complex128]) -> Array:
    return np.column_stack([at.real, at.imag])


def _near(at: NDArray[np.complex128], tree: cKDTree, reach: float) -> NDArray[np.bool_]:
    """(n,) whether points (n,) have one of the tree within reach."""
    return np.isfinite(tree.query(_xy(at), distance_upper_bound=reach)[0])
