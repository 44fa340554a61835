"""Map upkeep, method.md section 4: what is kept beside each line; extending, joining and forgetting lines."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.core.gaussian import chi2_gate, squared_distance_2
from bsmap_cli.core.table import take
from bsmap_cli.model import Array, IntArray, LineMap
from bsmap_cli.slam.filter import FilterState, constrain_equal, line_covariances, remove
from bsmap_cli.slam.segments import Segments

JOIN_ANGLE = 0.1
JOIN_OFFSET = 0.1
"""Radians and metres; lines farther apart are never tried."""


class Landmarks(NamedTuple):
    """What the map keeps of each line beside its parameters.

    extents : (m, 2), metres.  hits : (m,) scans that saw it.  last_seen : (m,) the last of these, counted in key scans.
    """

    extents: Array
    hits: IntArray
    last_seen: IntArray


def no_landmarks() -> Landmarks:
    """An empty map."""
    return Landmarks(np.zeros((0, 2)), np.zeros(0, int), np.zeros(0, int))


def extents_in_map(pose: Array, parameters: Array, extents: Array) -> Array:
    """(k, 2) extents of segments seen from the pose, along t of the map's frame."""
    alpha = parameters[:, 0] + pose[2]
    shift = -pose[0] * np.sin(alpha) + pose[1] * np.cos(alpha)
    return extents + shift[:, None]


def extend(
    state: FilterState, landmarks: Landmarks, segments: Segments, segment: IntArray, line: IntArray, step: int
) -> Landmarks:
    """Landmarks after the matched pairs, segment (k,) and line (k,), of a step: extents cover what they saw."""
    if len(line) == 0:
        return landmarks
    extents, hits, last_seen = landmarks.extents.copy(), landmarks.hits.copy(), landmarks.last_seen.copy()
    # The segment's end points, carried into the map and measured along the stored line.
    x, y, theta = state.pose.tolist()
    alpha, map_alpha = segments.parameters[segment, 0] + theta, state.lines[line, 0]
    turn = alpha - map_alpha
    shift = y * np.cos(map_alpha) - x * np.sin(map_alpha) + segments.parameters[segment, 1] * np.sin(turn)
    along = segments.extents[segment] * np.cos(turn)[:, None] + shift[:, None]
    np.minimum.at(extents[:, 0], line, along.min(axis=1))
    np.maximum.at(extents[:, 1], line, along.max(axis=1))
    seen = np.zeros(len(hits), bool)
    seen[line] = True
    hits += seen
    last_seen[line] = step
    return Landmarks(extents, hits, last_seen)


def follow(landmarks: Landmarks, before: Array, after: Array) -> Landmarks:
    """Landmarks after their lines turned from `before` (m, 2) to `after`: extents stay where they are on the wall.

    They are measured from the foot of the origin's normal, which slides along the line by r times the turn.
    """
    turn = se2.wrap(after[:, :1] - before[:, :1])
    return landmarks._replace(extents=landmarks.extents * np.cos(turn) - before[:, 1:] * np.sin(turn))


def append(landmarks: Landmarks, extents: Array, step: int) -> Landmarks:
    """Landmarks with new lines of extents (k, 2), seen for the first time."""
    ones = np.ones(len(extents), int)
    return Landmarks(
        np.r_[landmarks.extents, extents], np.r_[landmarks.hits, ones], np.r_[landmarks.last_seen, step * ones]
    )


def prune(
    state: FilterState, landmarks: Landmarks, step: int, fewest_hits: int, patience: int
) -> tuple[FilterState, Landmarks]:
    """Forget lines seen in fewer than `fewest_hits` scans and not in the last `patience` key scans: clutter, people."""
    stale = (landmarks.hits < fewest_hits) & (step - landmarks.last_seen > patience)
    for line in stale.nonzero()[0][::-1].tolist():
        state, landmarks = discard(state, landmarks, line)
    return state, landmarks


def join_lines(
    state: FilterState, landmarks: Landmarks, touched: list[int], gate: float, margin: float, noise: Array
) -> tuple[FilterState, Landmarks]:
    """Join stored lines that are one: same parameters within their joint covariance, extents that touch.

    touched : lines that this step changed; the others need no new look.  noise : (2, 2), by which parts of one wall
    may differ, for no wall is perfectly straight.
    """
    while (pair := _first_joinable(state, landmarks, touched, gate, margin, noise)) is not None:
        keep, drop = pair
        before = state.lines.copy()
        state = constrain_equal(state, keep, drop, noise)
        landmarks = follow(landmarks, before, state.lines)
        extents, hits, last_seen = landmarks.extents.copy(), landmarks.hits.copy(), landmarks.last_seen.copy()
        extents[keep] = min(extents[keep, 0], extents[drop, 0]), max(extents[keep, 1], extents[drop, 1])
        hits[keep] += hits[drop]
        last_seen[keep] = max(last_seen[keep], last_seen[drop])
        state, landmarks = discard(state, Landmarks(extents, hits, last_seen), drop)
        last = len(hits) - 1
        touched = sorted({drop if line == last else line for line in touched if line != drop} | {keep})
    return state, landmarks


def discard(state: FilterState, landmarks: Landmarks, line: int) -> tuple[FilterState, Landmarks]:
    """Forget a line; as in the filter, the last one takes its place."""
    rows = np.arange(len(landmarks.hits) - 1)
    rows[line:][:1] = len(rows)
    return remove(state, line), take(landmarks, rows)


def _first_joinable(
    state: FilterState, landmarks: Landmarks, touched: list[int], gate: float, margin: float, noise: Array
) -> tuple[int, int] | None:
    """Lines to join, the smaller index first; None when no pair passes."""
    pairs = _near_lines(state.lines, landmarks.extents, np.array(touched, int), margin)
    if len(pairs) == 0:
        return None
    index = (3 + 2 * pairs[:, :, None] + np.arange(2)).reshape(-1, 4)
    rows, columns = np.maximum(index[:, :, None], index[:, None]), np.minimum(index[:, :, None], index[:, None])
    C = state.covariance[rows, columns]
    S = C[:, :2, :2] + C[:, 2:, 2:] - C[:, :2, 2:] - C[:, 2:, :2] + noise
    difference = state.lines[pairs[:, 0]] - state.lines[pairs[:, 1]]
    difference[:, 0] = se2.wrap(difference[:, 0])
    passing = np.flatnonzero(squared_distance_2(difference, S) < chi2_gate(gate, 2))
    return tuple(pairs[passing[0]].tolist()) if len(passing) else None


def _near_lines(lines: Array, extents: Array, touched: IntArray, margin: float) -> IntArray:
    """(k, 2) pairs of lines worth a test, the smaller first: each of `touched` in turn with the others near it."""
    turn = se2.wrap(lines[:, 0] - lines[touched, :1])
    begin = np.maximum(extents[:, 0], extents[touched, :1])
    end = np.minimum(extents[:, 1], extents[touched, 1:])
    # Offset in the middle of the overlap (or of the gap); turning by a small angle moves a point at t by t times it.
    apart = lines[:, 1] - lines[touched, 1:] - turn * (begin + end) / 2
    near = (np.abs(turn) < JOIN_ANGLE) & (np.abs(apart) < JOIN_OFFSET) & (end - begin > -margin)
    near[np.arange(len(touched)), touched] = False
    row, other = np.nonzero(near)
    return np.sort(np.stack([touched[row], other], axis=1), axis=1)


def to_line_map(state: FilterState, landmarks: Landmarks) -> LineMap:
    """The filter's lines as they are stored in the map."""
    return with_positive_offset(state.lines, line_covariances(state), landmarks.extents, landmarks.hits)


def with_positive_offset(parameters: Array, covariances: Array, extents: Array, hits: IntArray) -> LineMap:
    """Lines (m, 2) whose n points away from where they were seen, turned to r >= 0; the side tells from where."""
    parameters, covariances, extents = parameters.copy(), covariances.copy(), extents.copy()
    flip = parameters[:, 1] < 0
    parameters[flip] = parameters[flip] * [1, -1] + [np.pi, 0]
    extents[flip] = -extents[flip][:, ::-1]
    covariances[flip, 0, 1] *= -1
    covariances[flip, 1, 0] *= -1
    parameters[:, 0] = se2.wrap(parameters[:, 0])
    return LineMap(parameters, covariances, extents, np.where(flip, 1, -1), hits)
