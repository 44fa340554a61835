"""Division of a trajectory into translations and rotations, method.md section 6: each gives one data set.

Standing still adds nothing: scans count only once the robot has moved on by a step. An arc is a translation while it
turns wide and a rotation where it turns about a point near the robot, for then its scan planes meet inside the room.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.model import Array, IntArray

STEP = 0.02
"""Metres: poses nearer than this and ROTATION_STEP to the last scan of a set count as standing still."""
ROTATION_STEP = 0.02
"""Radians. Both lie above the noise of a pose and below the steps of a robot that moves."""
TURN_RADIUS = 1.0
"""Metres: movement along a narrower arc is a rotation, along a wider one a translation."""
SHORTEST = 3
"""Steps: shorter runs are taken for noise, or the joint of two movements, and join the run before them."""
JUMP, ROTATION_JUMP = 1.0, np.pi / 4
"""Metres, radians between two scans: the data in between are missing, a set ends there."""
LARGEST_ROTATION = np.pi
LARGEST_TURN = np.pi / 2
"""Radians that a rotation and a translation may turn in all."""

FORWARD, BACKWARD, LEFT, RIGHT = range(4)


class Movement(NamedTuple):
    """A run of scans in one kind of movement: indices (k,) ascending; first and last are shared with the neighbours."""

    kind: str  # "translation" or "rotation"
    scans: IntArray


def divide(poses: Array, set_length: float) -> list[Movement]:
    """Data sets by movement.

    Parameters
    ----------
    poses : (m, 3) of base_link in map, one a scan, in the order of the scans.
    set_length : metres, longest translation in one set; longer ones are divided into equal parts.

    Returns
    -------
    list of Movement, each of two scans at least; one that is still has none.
    """
    kept = _moving_scans(poses)
    steps = se2.between(poses[kept[:-1]], poses[kept[1:]])
    movements = []
    for start, stop in _pieces_without_jump(steps):
        labels = _join_short_runs(_label(steps[start:stop]))
        for first, last in _runs(labels):
            part = steps[start + first : start + last]
            kind = "rotation" if labels[first] in (LEFT, RIGHT) else "translation"
            cuts = start + first + _cuts(part, kind, set_length)
            movements += [Movement(kind, kept[a : b + 1]) for a, b in itertools.pairwise(cuts)]
    return movements


def _moving_scans(poses: Array) -> IntArray:
    """Indices of the scans that lie at least a step away from the one kept before."""
    kept = [0] if len(poses) else []
    for index in range(1, len(poses)):
        x, y, theta = poses[index] - poses[kept[-1]]
        if np.hypot(x, y) >= STEP or abs(se2.wrap(theta)) >= ROTATION_STEP:
            kept.append(index)
    return np.array(kept, dtype=np.int64)


def _pieces_without_jump(steps: Array) -> list[tuple[int, int]]:
    """Ranges (start, stop) of steps between those too long for neighbouring scans."""
    jump = (np.hypot(steps[:, 0], steps[:, 1]) > JUMP) | (np.abs(steps[:, 2]) > ROTATION_JUMP)
    borders = np.concatenate([[-1], np.flatnonzero(jump), [len(steps)]])
    return [(a + 1, b) for a, b in itertools.pairwise(borders) if b > a + 1]


def _label(steps: Array) -> NDArray[np.int64]:
    """FORWARD, BACKWARD, LEFT or RIGHT for each step (x, y, theta) in the frame of the pose before it."""
    rotation = np.abs(steps[:, 2]) * TURN_RADIUS > np.hypot(steps[:, 0], steps[:, 1])
    return np.where(rotation, np.where(steps[:, 2] > 0, LEFT, RIGHT), np.where(steps[:, 0] >= 0, FORWARD, BACKWARD))


def _runs(labels: NDArray[np.int64]) -> list[tuple[int, int]]:
    """Ranges (first, stop) of equal labels."""
    borders = np.concatenate([[0], np.flatnonzero(np.diff(labels)) + 1, [len(labels)]])
    return list(zip(borders[:-1].tolist(), borders[1:].tolist(), strict=True))


def _join_short_runs(labels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Give runs shorter than SHORTEST the label of the longer neighbour, the shortest first."""
    labels = labels.copy()
    while True:
        runs = _runs(labels)
        lengths = [stop - first for first, stop in runs]
        shortest = int(np.argmin(lengths))
        if len(runs) == 1 or lengths[shortest] >= SHORTEST:
            return labels
        neighbours = [i for i in (shortest - 1, shortest + 1) if 0 <= i < len(runs)]
        longer = max(neighbours, key=lambda i: lengths[i])
        labels[slice(*runs[shortest])] = labels[runs[longer][0]]


def _cuts(steps: Array, kind: str, set_length: float) -> IntArray:
    """Borders (k + 1,) of the k equal parts, in steps, so that none is too long nor turns too far."""
    turn = np.concatenate([[0.0], np.cumsum(np.abs(steps[:, 2]) if kind == "rotation" else steps[:, 2])])
    length = np.concatenate([[0.0], np.cumsum(np.hypot(steps[:, 0], steps[:, 1]))])
    if kind == "rotation":
        along, limit = turn, LARGEST_ROTATION
    else:
        # The net turn: noise in the heading does not add up.
        along, limit = length, min(set_length, LARGEST_TURN * length[-1] / max(np.ptp(turn), 1e-9))
    # A few per cent over the limit are no reason to halve a set.
    parts = max(1, int(np.ceil(along[-1] / limit - 0.05)))
    inner = np.searchsorted(along, along[-1] * np.arange(1, parts) / parts)
    return np.unique(np.concatenate([[0], inner, [len(steps)]])).astype(np.int64)
