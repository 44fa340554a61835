"""Lines out of sight are laid aside, so that the filter's state holds what is near, however large the building."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.table import joined, take
from bsmap_cli.model import Array
from bsmap_cli.slam import filter
from bsmap_cli.slam.filter import FilterState
from bsmap_cli.slam.upkeep import Landmarks, discard, no_landmarks

REACH = 15.0
"""Metres from the robot within which a line may be seen again."""
UNSEEN = 20
"""Key scans without a sight of it after which a line beyond REACH is laid aside."""
EVERY = 5
"""Key scans from one look around to the next."""


class Shelf(NamedTuple):
    """lines : (m, 2) alpha, r as in the state.  covariances : (m, 2, 2), marginal.  landmarks : of these lines."""

    lines: Array
    covariances: Array
    landmarks: Landmarks


def empty_shelf() -> Shelf:
    """A shelf without lines."""
    return Shelf(np.zeros((0, 2)), np.zeros((0, 2, 2)), no_landmarks())


def distances(pose: Array, lines: Array, extents: Array) -> Array:
    """(m,) metres from the robot to the nearest point of each segment."""
    c, s = np.cos(lines[:, 0]), np.sin(lines[:, 0])
    across, along = pose[0] * c + pose[1] * s - lines[:, 1], pose[1] * c - pose[0] * s
    return np.hypot(across, along - np.clip(along, extents[:, 0], extents[:, 1]))


def look_around(
    state: FilterState, landmarks: Landmarks, shelf: Shelf, step: int
) -> tuple[FilterState, Landmarks, Shelf]:
    """Take back lines that came near, lay aside those that are far and unseen for long.

    What is laid aside loses its correlation with the rest, which is small: the trajectory is anchored elsewhere.
    """
    near = distances(state.pose, shelf.lines, shelf.landmarks.extents) < REACH
    far = distances(state.pose, state.lines, landmarks.extents) > REACH
    aside = np.flatnonzero(far & (step - landmarks.last_seen > UNSEEN))
    if len(aside) == 0 and not near.any():
        return state, landmarks, shelf
    covariances = filter.line_covariances(state, aside)
    laid = Shelf(state.lines[aside].copy(), covariances, take(landmarks, aside))
    for line in aside[::-1]:
        state, landmarks = discard(state, landmarks, int(line))
    for k in np.flatnonzero(near):
        state = filter.insert(state, shelf.lines[k], shelf.covariances[k])
    landmarks = joined([landmarks, take(shelf.landmarks, near)])
    return state, landmarks, put(take_rows(shelf, ~near), laid)


def take_rows(shelf: Shelf, rows: NDArray[np.bool_]) -> Shelf:
    """The lines of a shelf that `rows` chooses."""
    return Shelf(shelf.lines[rows], shelf.covariances[rows], take(shelf.landmarks, rows))


def put(shelf: Shelf, more: Shelf) -> Shelf:
    """Both shelves' lines."""
    return Shelf(
        np.concatenate([shelf.lines, more.lines]),
        np.concatenate([shelf.covariances, more.covariances]),
        joined([shelf.landmarks, more.landmarks]),
    )
