"""Smoothing: key poses and lines together, by sparse Gauss-Newton over the pose graph and every line seen.

The filter decides which lines there are; here every segment of every key scan is matched to them again from the
smoothed poses, and poses and lines are solved for at once, so that nothing hangs on the order in which it was seen. How
large the errors of motion, closures and lines really are is told by what is left of them: variance components.
"""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU

from bsmap_cli.core import se2
from bsmap_cli.model import Array, IntArray, LineMap
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import posegraph
from bsmap_cli.slam.posegraph import Edges, Term
from bsmap_cli.slam.scatter import weighed
from bsmap_cli.slam.segments import Segments
from bsmap_cli.slam.sightings import Sightings, extents_and_hits, match_all, sighting_term, with_rivals

ITERATIONS, HONEST_ITERATIONS = (2, 2, 4), 4
"""Steps of Gauss-Newton after each matching of segments to lines; of the variances at the poses found."""
CONVERGED, SETTLED = 1e-4, 0.01
"""Metres and radians: poses that move less are found; relative change of the variances' scales at which these are."""
POSE_SPREAD = (0.05, 0.015)
"""Metres and radians by which a key pose may be off when segments are matched to lines for the first time."""
LEAST_SCALE, MOST_SCALE = 0.02, 50.0
"""Limits of what the errors' variances may be off by in one step."""
LEAST_ODOMETRY_SCALE, LEAST_STEP_SCALE = 0.04, 0.05
"""Least scales of the variances of odometry and of steps as they were tracked. Where hardly anything contradicts the
steps, as along a bare corridor, they would otherwise seem exact, and lines could no longer correct them."""


class Smoothed(NamedTuple):
    """poses : (n, 3).  lines : (m, 2) alpha, r with n pointing away from where the robot saw them.

    extents : (m, 2).  hits : (m,) key scans that saw the line.  information : sparse, of all poses and lines but the
    first pose, which is held.  scales : (2,) of the variances of steps and closures in it.
    """

    poses: Array
    lines: Array
    extents: Array
    hits: IntArray
    information: sparse.csc_matrix
    scales: Array


class Evidence(NamedTuple):
    """What is known of the key poses beside the lines: steps from one to the next, and closures (or other matches)."""

    steps: Edges
    closures: Edges


class _Problem(NamedTuple):
    """All observations: steps, closures, lines seen."""

    steps: Edges
    closures: Edges
    sightings: Sightings

    def scaled(self, scales: Array) -> "_Problem":
        """With the variances of steps and closures times `scales` (2,)."""
        return self._replace(
            steps=self.steps._replace(information=self.steps.information / scales[0]),
            closures=self.closures._replace(information=self.closures.information / scales[1]),
        )

    def terms(self, poses: Array, lines: Array) -> list[Term]:
        """What each part says at these poses and lines."""
        edges = [posegraph.edge_term(poses, part) for part in (self.steps, self.closures)]
        return [*edges, sighting_term(poses, lines, self.sightings)]


def smooth(
    poses: Array, every: Evidence, distinct: Evidence, segments: Segments, lines: LineMap, params: SlamParams
) -> Smoothed:
    """Poses (n, 3) and lines that agree best with all evidence and with the segments of the key scans.

    every : all that helps to find the poses; matches among it use the same points as the lines.
    distinct : no noise twice in it; from it, once the pairs are found, come the last step and the information.
    segments : `scan` is the key pose.  params : gate and margin of the filter's association, floors of a segment.
    """
    floors = np.array([params.line_angle_floor, params.line_offset_floor])
    flip = lines.sides > 0  # back to n pointing away from the robot
    parameters = np.where(flip[:, None], lines.parameters * [1, -1] + [np.pi, 0], lines.parameters)
    extents = np.where(flip[:, None], -lines.extents[:, ::-1], lines.extents)
    spread, scales = POSE_SPREAD, np.ones(2)
    for iterations in ITERATIONS:
        sightings = match_all(poses, parameters, extents, segments, params.gate, params.overlap_margin, spread)
        for _ in range(iterations):
            problem = _Problem(*every, sightings).scaled(scales)
            poses, parameters, factors, largest = _step(poses, parameters, problem)
            scales = scales * _variance_components(problem, poses, parameters, factors)
            scales = np.maximum(scales, [LEAST_STEP_SCALE, 0.0])
            sightings = weighed(poses, parameters, sightings, segments, floors, factors)
            del factors  # each takes tens of megabytes: the old ones go before the new ones come
            if largest < CONVERGED:
                break
        extents, _ = extents_and_hits(poses, parameters, sightings, segments)
        spread = (POSE_SPREAD[0] / 2, POSE_SPREAD[1] / 2)
    sightings = with_rivals(poses, parameters, extents, sightings, segments, params.gate, params.overlap_margin)
    poses, parameters, information, scales = _honest(
        poses, parameters, _Problem(*distinct, sightings), segments, floors
    )
    extents, hits = extents_and_hits(poses, parameters, sightings, segments)
    return Smoothed(poses, parameters, extents, hits, information, scales)


def _honest(
    poses: Array, lines: Array, problem: _Problem, segments: Segments, floors: Array
) -> tuple[Array, Array, sparse.csc_matrix, Array]:
    """Poses and lines by what counts no noise twice, their information, and the variances' scales (2,).

    The information tells how far off the poses are that agree best with the same evidence. Those that more evidence
    found, which errs together, may be farther off: steps along a corridor, all a little long, drew out its doors.
    """
    scales = np.ones(2)
    for _ in range(HONEST_ITERATIONS):
        scaled = problem.scaled(scales)
        poses, lines, factors, largest = _step(poses, lines, scaled)
        before, scales = scales, scales * _variance_components(scaled, poses, lines, factors)
        # What odometry is off by in a few steps says little of its drift, which is systematic; and that neighbouring
        # matches, which share most of their points, agree does not make them better.
        scales = np.maximum(scales, [LEAST_ODOMETRY_SCALE, 1.0])
        problem = problem._replace(sightings=weighed(poses, lines, problem.sightings, segments, floors, factors))
        del factors
        if largest < CONVERGED and np.abs(np.log(scales / before)).max() < SETTLED:
            break
    return poses, lines, _normal_matrix(problem.scaled(scales).terms(poses, lines), poses, lines, problem, True), scales


def _step(poses: Array, lines: Array, problem: _Problem) -> tuple[Array, Array, SuperLU, float]:
    """Poses and lines after a step of Gauss-Newton, the factors that it took, and the poses' largest change."""
    terms = problem.terms(poses, lines)
    side = np.zeros(3 * len(poses) + 2 * len(lines))
    for term in terms:
        posegraph.add_side(side, term)
    factors = posegraph.factorise(_normal_matrix(terms, poses, lines, problem))
    poses, lines, largest = _stepped(poses, lines, factors.solve(side[3:]))
    return poses, lines, factors, largest


def _normal_matrix(
    terms: list[Term], poses: Array, lines: Array, problem: _Problem, gained: bool = False
) -> sparse.csc_matrix:
    """Normal matrix of all unknowns but the first pose, which is held.

    gained : with what the poses' information gains on the mean robust weight.
    """
    n, m = len(poses), len(lines)
    size = 3 * n + 2 * m
    # A line that no segment is matched to any more stays where it is.
    unseen = np.setdiff1d(np.arange(m), problem.sightings.line)
    held = 3 * n + (2 * unseen[:, None] + np.arange(2)).ravel()
    matrix = sparse.csc_matrix((np.ones(len(held)), (held, held)), shape=(size, size))
    for term in terms:
        matrix = matrix + posegraph.term_matrix(term, size) * (term.gain if gained else 1.0)
    return sparse.csc_matrix(matrix[3:, 3:])


def _stepped(poses: Array, lines: Array, step: Array) -> tuple[Array, Array, float]:
    """Poses and lines after a step of all unknowns but the first pose, and the poses' largest change."""
    step = np.concatenate([np.zeros(3), step])
    n = len(poses)
    poses, lines = poses + step[: 3 * n].reshape(-1, 3), lines + step[3 * n :].reshape(-1, 2)
    poses[:, 2] = se2.wrap(poses[:, 2])
    return poses, lines, float(np.abs(step[: 3 * n]).max())


def _variance_components(problem: _Problem, poses: Array, lines: Array, factors: SuperLU) -> Array:
    """(2,) by how much the variances of steps and closures are too small (Foerstner 1979): residuals over redundancy.

    The redundancy of a part is its number of observations less the trace of N^-1 N_part, which random vectors of signs
    estimate (Hutchinson 1990).
    """
    size = 3 * len(poses) + 2 * len(lines)
    signs = posegraph.probes(size - 3, size)
    solved = factors.solve(signs)
    scales = np.ones(2)
    for k, part in enumerate((problem.steps, problem.closures)):
        term = posegraph.edge_term(poses, part)
        matrix = posegraph.term_matrix(term, size)[3:, 3:]
        redundancy = term.observations - float(np.einsum("ik,ik->", solved, matrix @ signs)) / signs.shape[1]
        # Without much left over, a part tells nothing of its own errors.
        if redundancy > max(10.0, 0.05 * term.observations):
            scales[k] = np.clip(term.distance / (term.share * redundancy), LEAST_SCALE, MOST_SCALE)
    return scales
