"""Lines seen from key poses: every segment matched to the line it is part of, and what the pairs say of both."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.gaussian import chi2_gate
from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.posegraph import ROBUST_WIDTH, Term, robust_means
from bsmap_cli.slam.segments import Segments
from bsmap_cli.slam.shelf import distances

AT_ONCE = 100
"""Segments compared with the lines about them at a time."""
MOST_TURN, BEYOND_SIGHT = 0.2, 5.0
"""Radians between a segment and a line that it may be part of; metres that a line may be farther off than anything that
was seen."""


class Sightings(NamedTuple):
    """Lines seen from key poses. pose, line : (m,).  observed : (m, 2) alpha, r in base_link.  information : (m, 2, 2).

    segment : (m,), which of the segments it is.  rival : (m, 2) squared distances, in direction and offset at the
    segment's centre, to the line farthest from this one that it may be as well; 0 where there is none.
    """

    pose: IntArray
    line: IntArray
    observed: Array
    information: Array
    segment: IntArray
    rival: Array


def match_all(
    poses: Array,
    lines: Array,
    extents: Array,
    segments: Segments,
    gate: float,
    margin: float,
    spread: tuple[float, float],
) -> Sightings:
    """The nearest line of each segment that passes the gate, given how far a pose can be off: metres, radians."""
    found = []
    for start in range(0, len(segments.scan), AT_ONCE):
        rows = np.arange(start, min(start + AT_ONCE, len(segments.scan)))
        found.append(_match_some(poses, lines, extents, segments, rows, margin, spread))
    none = np.zeros(0, int)
    segment, line = (np.concatenate([none, *(part[k] for part in found)]) for k in (0, 1))
    near = np.concatenate([none, *(part[2] for part in found)]) < chi2_gate(gate, 2)
    segment, line = segment[near], line[near]
    information = np.linalg.inv(segments.covariances[segment])
    none = np.zeros((len(segment), 2))
    return Sightings(segments.scan[segment], line, segments.parameters[segment], information, segment, none)


def _match_some(
    poses: Array,
    lines: Array,
    extents: Array,
    segments: Segments,
    rows: IntArray,
    margin: float,
    spread: tuple[float, float],
) -> tuple[IntArray, IntArray, Array]:
    """Segments of `rows` that lie beside a line, that line, and the squared distance."""
    a, b, turn, apart = _beside(poses, lines, extents, segments, rows, margin)
    # Compared in the middle of the segment, where direction and offset are nearly independent.
    C, middle = segments.covariances[rows[a]], segments.extents[rows[a]].mean(axis=1)
    offset_variance = C[:, 1, 1] - 2 * middle * C[:, 0, 1] + middle**2 * C[:, 0, 0] + spread[0] ** 2
    distance = turn**2 / (C[:, 0, 0] + spread[1] ** 2) + apart**2 / offset_variance
    order = np.lexsort((distance, a))
    nearest = order[np.diff(a[order], prepend=-1) > 0]
    return rows[a[nearest]], b[nearest], distance[nearest]


def _beside(
    poses: Array, lines: Array, extents: Array, segments: Segments, rows: IntArray, margin: float
) -> tuple[IntArray, IntArray, Array, Array]:
    """Pairs of segments among `rows` and lines that lie side by side: which of either, (k,).

    And how far apart they are: in direction (k,), and in the middle of the segment (k,).
    """
    pose, seen = poses[segments.scan[rows]], segments.parameters[rows]
    in_map = extents_of(pose, seen, segments.extents[rows])
    within = np.flatnonzero(_within_sight(pose, seen, segments.extents[rows], lines, extents))
    lines, extents = lines[within], extents[within]
    turn = se2.wrap((seen[:, 0] + pose[:, 2])[:, None] - lines[:, 0])
    a, b = np.nonzero(np.abs(turn) < MOST_TURN)
    overlap = np.minimum(in_map[a, 1], extents[b, 1]) - np.maximum(in_map[a, 0], extents[b, 0])
    beside = overlap > -margin
    a, b = a[beside], b[beside]
    turn = turn[a, b]
    alpha = lines[b, 0]
    r = lines[b, 1] - pose[a, 0] * np.cos(alpha) - pose[a, 1] * np.sin(alpha)
    middle = segments.extents[rows[a]].mean(axis=1)
    return a, within[b], turn, seen[a, 1] - r - turn * middle


def with_rivals(
    poses: Array, lines: Array, extents: Array, sightings: Sightings, segments: Segments, gate: float, margin: float
) -> Sightings:
    """Sightings that tell how far off they are if their segments belong to other lines that explain them as well.

    Along a curved wall a segment lies between the chords that were mapped. Poses that are off have it paired with
    another of these, to which it then is as near: what it says of the poses is no surer than the chords are apart.

    gate : quantile within which a line that is farther away may still be the true one.
    """
    limit = chi2_gate(gate, 2)
    rival = np.zeros((len(sightings.segment), 2))
    variances = np.linalg.inv(sightings.information)
    for start in range(0, len(rival), AT_ONCE):
        some = slice(start, start + AT_ONCE)
        rows, C = sightings.segment[some], variances[some]
        a, b, turn, apart = _beside(poses, lines, extents, segments, rows, margin)
        middle = segments.extents[rows].mean(axis=1)
        offset = C[:, 1, 1] - 2 * middle * C[:, 0, 1] + middle**2 * C[:, 0, 0]
        distance = turn**2 / C[a, 0, 0] + apart**2 / offset[a]
        own = np.full((3, len(rows)), np.inf)
        mine = b == sightings.line[some][a]
        own[:, a[mine]] = distance[mine], turn[mine], apart[mine]
        near = np.isfinite(own[0, a]) & (distance < own[0, a] + limit)
        for k, difference in enumerate((turn - own[1, a], apart - own[2, a])):
            np.maximum.at(rival[some, k], a[near], difference[near] ** 2)
    return sightings._replace(rival=rival)


def _within_sight(poses: Array, seen: Array, seen_extents: Array, lines: Array, extents: Array) -> NDArray[np.bool_]:
    """(m,) lines no farther from the middle of some poses (k, 3) than what was seen (k, 2) from any of them may be.

    For the others the time would grow with the square of the building.
    """
    middle = poses[:, :2].mean(axis=0)
    around = np.hypot(*(poses[:, :2] - middle).T).max()
    farthest = np.hypot(seen[:, 1], np.abs(seen_extents).max(axis=1)).max()
    return distances(middle, lines, extents) < around + farthest + BEYOND_SIGHT


def extents_of(poses: Array, parameters: Array, extents: Array) -> Array:
    """(k, 2) extents in map of segments (k,), each seen from its own pose (k, 3)."""
    alpha = parameters[:, 0] + poses[:, 2]
    shift = -poses[:, 0] * np.sin(alpha) + poses[:, 1] * np.cos(alpha)
    return extents + shift[:, None]


def errors(poses: Array, lines: Array, sightings: Sightings) -> Array:
    """(m, 2) observed alpha and r less what poses (n, 3) and lines (k, 2) make of them, Eq. (9)."""
    pose, (alpha, r) = poses[sightings.pose], lines[sightings.line].T
    turn = se2.wrap(sightings.observed[:, 0] - alpha + pose[:, 2])
    apart = sightings.observed[:, 1] - r + pose[:, 0] * np.cos(alpha) + pose[:, 1] * np.sin(alpha)
    return np.stack([turn, apart], axis=1)


def derivatives(poses: Array, lines: Array, sightings: Sightings) -> tuple[Array, Array]:
    """Of `errors` by the pose (m, 2, 3) and by the line (m, 2, 2), Eq. (10)."""
    pose, alpha = poses[sightings.pose], lines[sightings.line, 0]
    c, s = np.cos(alpha), np.sin(alpha)
    by_pose = np.zeros((len(alpha), 2, 3))
    by_pose[:, 0, 2], by_pose[:, 1, 0], by_pose[:, 1, 1] = 1.0, c, s
    by_line = np.zeros((len(alpha), 2, 2))
    by_line[:, 0, 0] = by_line[:, 1, 1] = -1.0
    by_line[:, 1, 0] = pose[:, 1] * c - pose[:, 0] * s
    return by_pose, by_line


def sighting_term(poses: Array, lines: Array, sightings: Sightings) -> Term:
    """Blocks of the lines seen, Eq. (9)-(10), with a robust weight: a false match must not bend the map."""
    error, (by_pose, by_line) = errors(poses, lines, sightings), derivatives(poses, lines, sightings)
    distance = np.einsum("mi,mij,mj->m", error, sightings.information, error)
    weight = 1.0 / (1.0 + distance / ROBUST_WIDTH)
    weights = sightings.information * weight[:, None, None]
    i, j = 3 * sightings.pose, 3 * len(poses) + 2 * sightings.line
    pose_w, line_w = np.swapaxes(by_pose, 1, 2) @ weights, np.swapaxes(by_line, 1, 2) @ weights
    cross = pose_w @ by_line
    blocks = [
        (i, i, pose_w @ by_pose),
        (j, j, line_w @ by_line),
        (i, j, cross),
        (j, i, np.swapaxes(cross, 1, 2)),
    ]
    sides = [(i, -np.einsum("mij,mj->mi", pose_w, error)), (j, -np.einsum("mij,mj->mi", line_w, error))]
    means = robust_means(2)
    share = means.distance / (2 * means.weight)
    return Term(blocks, sides, float(weight @ distance), 2 * float(weight.sum()), share, means.gain)


def extents_and_hits(poses: Array, lines: Array, sightings: Sightings, segments: Segments) -> tuple[Array, IntArray]:
    """Extents (m, 2) of what was seen of each line, and key scans (m,) that saw it."""
    pose, alpha = poses[sightings.pose], sightings.observed[:, 0]
    n, t = np.stack([np.cos(alpha), np.sin(alpha)], -1), np.stack([-np.sin(alpha), np.cos(alpha)], -1)
    map_alpha = lines[sightings.line, 0]
    along = np.stack([-np.sin(map_alpha), np.cos(map_alpha)], -1)
    extents = np.tile([np.inf, -np.inf], (len(lines), 1))
    for end in (0, 1):
        point = n * sightings.observed[:, 1:] + t * segments.extents[sightings.segment, end : end + 1]
        at = np.einsum("ij,ij->i", se2.transform(pose, point), along)
        np.minimum.at(extents[:, 0], sightings.line, at)
        np.maximum.at(extents[:, 1], sightings.line, at)
    seen = np.unique(np.stack([sightings.line, sightings.pose], axis=1), axis=0)[:, 0]
    return extents, np.bincount(seen, minlength=len(lines))
