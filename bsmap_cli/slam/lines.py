"""The line filter along a trajectory that is known well: which lines there are, and the statistics of each step."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.core.table import take
from bsmap_cli.model import Array, IntArray, LineMap
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import filter
from bsmap_cli.slam.paper import line_step
from bsmap_cli.slam.segments import Segments
from bsmap_cli.slam.shelf import EVERY, Shelf, empty_shelf, look_around, put
from bsmap_cli.slam.upkeep import no_landmarks, with_positive_offset

STEP_SPREAD = np.array([0.01, 0.01, 0.004])
ANCHOR_SPREAD = np.array([0.05, 0.05, 0.01])
"""Metres and radians by which a step of the trajectory, and a pose of it, can be off."""


class MappedLines(NamedTuple):
    """lines : the map. counts : (n, 3) new segments, stored lines, matched pairs of each key scan. nis : (n,)."""

    lines: LineMap
    counts: IntArray
    nis: Array


def map_lines(poses: Array, segments: Segments, params: SlamParams) -> MappedLines:
    """Lines seen along key poses (n, 3), by the filter of Eq. (6)-(15) with the trajectory as its motion and anchor.

    segments : `scan` is the key pose.
    """
    n = len(poses)
    counts, nis = np.zeros((n, 3), int), np.zeros(n)
    state, landmarks, shelf = filter.initial_state(poses[0]), no_landmarks(), empty_shelf()
    border = np.searchsorted(segments.scan, np.arange(n + 1)).tolist()
    step_noise, anchor = np.diag(STEP_SPREAD) ** 2, np.diag(ANCHOR_SPREAD) ** 2
    for k in range(n):
        if k > 0:
            state = filter.predict(state, se2.between(poses[k - 1], poses[k]), step_noise)
            state = filter.update_pose(state, poses[k], anchor)
        if k % EVERY == 0:
            state, landmarks, shelf = look_around(state, landmarks, shelf, k)
        seen = take(segments, slice(border[k], border[k + 1]))
        state, landmarks, matched, nis[k] = line_step(state, landmarks, seen, k, params)
        counts[k] = len(seen.scan), len(landmarks.hits) + len(shelf.lines), matched
    whole = put(Shelf(state.lines, filter.line_covariances(state), landmarks), shelf)
    kept = whole.landmarks
    return MappedLines(with_positive_offset(whole.lines, whole.covariances, kept.extents, kept.hits), counts, nis)
