"""Data association, method.md section 3: individual and joint compatibility, partial compatibility algorithm (PCA)."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dposv

from bsmap_cli.core import se2
from bsmap_cli.core.gaussian import chi2_gate, squared_distance_2
from bsmap_cli.errors import BsmapError
from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.filter import FilterState, add_blocks, expected_lines, gather, stacked_jacobian, state_index
from bsmap_cli.slam.segments import Segments

MAX_ANGLE = 0.5
"""Radians; pairs farther apart are not looked at."""


class Candidates(NamedTuple):
    """Pairs that are individually compatible, by segment, nearest first.

    segment, line : (k,).  innovation : (2 k,), stacked.  covariance : (2 k, 2 k), of the stacked innovations; blocks of
    two pairs of one segment mean nothing, for no hypothesis holds both.  distance : (k,) squared Mahalanobis.
    """

    segment: IntArray
    line: IntArray
    innovation: Array
    covariance: Array
    distance: Array

    def joint_distance(self, pairs: Sequence[int]) -> float:
        """Squared Mahalanobis distance of the hypothesis that holds these pairs."""
        if len(pairs) == 1:
            return float(self.distance[pairs[0]])
        index = np.array([i for p in pairs for i in (2 * p, 2 * p + 1)])
        v = self.innovation[index]
        solved, failed = dposv(self.covariance[index[:, None], index], v)[1:]
        if failed:
            raise BsmapError("the joint covariance of matched lines is no longer positive definite")
        return float(v @ solved)

    def of_segment(self) -> dict[int, list[int]]:
        """Pairs of each segment that has any, nearest first."""
        out: dict[int, list[int]] = {}
        for pair, segment in enumerate(self.segment.tolist()):
            out.setdefault(segment, []).append(pair)
        return out


def find_candidates(state: FilterState, extents: Array, segments: Segments, gate: float, margin: float) -> Candidates:
    """Pairs of segments and map lines that pass the individual compatibility test and lie beside each other.

    extents : (m, 2) of the map's lines along their t, metres.  margin : metres by which extents may miss each other.
    That n points away from the robot in both makes sure that the same side is seen.
    """
    near = _near_pairs(state, extents, segments, margin)
    empty = Candidates(*near, np.zeros(0), np.zeros((0, 0)), np.zeros(0))
    if len(near[0]) == 0:
        return empty
    segment, line = near
    innovation, covariance = _innovations(state, segments, segment, line)
    pair = np.arange(len(line))
    blocks = covariance.reshape(len(line), 2, len(line), 2)[pair, :, pair]
    distance = squared_distance_2(innovation, blocks)
    order = np.lexsort((distance, segment))
    order = order[distance[order] <= chi2_gate(gate, 2)]
    index = (2 * order[:, None] + np.arange(2)).ravel()
    return Candidates(
        segment[order], line[order], innovation[order].ravel(), covariance[index[:, None], index], distance[order]
    )


def _near_pairs(state: FilterState, extents: Array, segments: Segments, margin: float) -> tuple[IntArray, IntArray]:
    """Pairs worth a test: similar direction, extents that overlap or nearly so, and not far apart in between."""
    x, y, _ = state.pose.tolist()
    expected, alpha = expected_lines(state.pose, state.lines), state.lines[:, 0]
    shift = -x * np.sin(alpha) + y * np.cos(alpha)
    low, high = extents[:, 0] - shift, extents[:, 1] - shift
    turn = se2.wrap(segments.parameters[:, None, 0] - expected[None, :, 0])
    begin = np.maximum(segments.extents[:, None, 0], low[None])
    end = np.minimum(segments.extents[:, None, 1], high[None])
    # Two lines that differ in direction are compared where they are seen, not at the foot of the normal.
    middle = (segments.extents[:, 0] + segments.extents[:, 1]) / 2
    apart = segments.parameters[:, None, 1] - expected[None, :, 1] - turn * middle[:, None]
    sigma = [math.sqrt(max(float(state.covariance[k, k]), 0.0)) for k in (0, 1)]
    reach = 0.5 + 4.0 * sum(sigma)
    near = (np.abs(turn) < MAX_ANGLE) & (end - begin > -margin) & (np.abs(apart) < reach)
    segment, line = np.nonzero(near)
    return segment, line


def _innovations(state: FilterState, segments: Segments, segment: IntArray, line: IntArray) -> tuple[Array, Array]:
    """Innovations (k, 2) of pairs and the covariance (2 k, 2 k) of all of them stacked, correlations included."""
    P = gather(state.covariance, state_index(line))
    seen = state.lines[line]
    H = stacked_jacobian(state.pose, seen[:, 0])
    innovation = segments.parameters[segment] - expected_lines(state.pose, seen)
    innovation[:, 0] = se2.wrap(innovation[:, 0])
    covariance = H @ P @ H.T
    add_blocks(covariance, segments.covariances[segment])
    return innovation, covariance


def best_joint_match(candidates: Candidates, segments: Sequence[int], gate: float) -> list[int]:
    """Branch and bound for the largest jointly compatible hypothesis of these segments, the nearest of equal ones.

    This is joint compatibility branch and bound (Neira and Tardos 2001): exponential, hence for small groups.
    """
    return _best_joint_match(candidates, candidates.of_segment(), segments, gate)


def _best_joint_match(
    candidates: Candidates, of_segment: dict[int, list[int]], segments: Sequence[int], gate: float
) -> list[int]:
    chosen: list[int] = []
    best: tuple[int, float, list[int]] = (0, 0.0, [])

    def descend(depth: int, distance: float) -> None:
        nonlocal best
        most = len(chosen) + len(segments) - depth
        if most < best[0] or (most == best[0] and distance >= best[1]):
            return  # a pair more never makes the distance less
        if depth == len(segments):
            if len(chosen) > best[0] or (len(chosen) == best[0] and distance < best[1]):
                best = (len(chosen), distance, list(chosen))
            return
        for pair in of_segment.get(segments[depth], ()):
            # Two segments may share a line: parts of one wall with a door between them.
            chosen.append(pair)
            joint = candidates.joint_distance(chosen)
            if joint <= chi2_gate(gate, 2 * len(chosen)):
                descend(depth + 1, joint)
            chosen.pop()
        descend(depth + 1, distance)

    descend(0, 0.0)
    return best[2]


def partial_compatibility(candidates: Candidates, order: Sequence[int], group_size: int, gate: float) -> list[int]:
    """Matching vector by the partial compatibility algorithm: pairs (indices into `candidates`), jointly compatible.

    order : segments in order of bearing; neighbours form groups of `group_size`. Each group's best joint match joins
    the whole if that stays jointly compatible; else its single pairs and the nearest candidates do, one by one.
    """
    of_segment = candidates.of_segment()
    seen = [s for s in order if s in of_segment]
    whole: list[int] = []
    for start in range(0, len(seen), group_size):
        group = seen[start : start + group_size]
        local = _best_joint_match(candidates, of_segment, group, gate)
        if local and (not whole or _compatible(candidates, whole + local, gate)):
            whole += local
            continue
        nearest = [of_segment[s][0] for s in group]
        taken: set[int] = set()
        for pair in sorted({*local, *nearest}, key=lambda p: (candidates.distance[p], p)):
            segment = int(candidates.segment[pair])
            if segment not in taken and _compatible(candidates, [*whole, pair], gate):
                whole.append(pair)
                taken.add(segment)
    return whole


def _compatible(candidates: Candidates, pairs: Sequence[int], gate: float) -> bool:
    return candidates.joint_distance(pairs) <= chi2_gate(gate, 2 * len(pairs))
