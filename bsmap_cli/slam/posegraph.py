"""Pose graph in the plane: sparse Gauss-Newton with a robust loss (Grisetti et al. 2010; Kuemmerle et al. 2011)."""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu
from scipy.special import roots_genlaguerre

from bsmap_cli.core import se2
from bsmap_cli.errors import BsmapError
from bsmap_cli.model import Array, IntArray

ITERATIONS = 30
PROBES, MOST_NUMBERS = (8, 64), 60000
"""Random vectors at least and at most; numbers in all of them beyond which there are fewer."""
ROBUST_WIDTH = 9.0
"""Squared Mahalanobis distance at which the weight of a robust edge has fallen to one half (Cauchy)."""


def probes(rows: int, unknowns: int) -> Array:
    """(rows, k) random signs for the trace or the diagonal of what the inverse of a matrix of `unknowns` makes.

    The fewer unknowns, the less they cost and the more are needed; the seed is fixed, so that the same data give the
    same numbers.
    """
    count = int(np.clip(MOST_NUMBERS // max(unknowns, 1), *PROBES))
    return np.random.default_rng(0).choice([-1.0, 1.0], size=(rows, count))


class Edges(NamedTuple):
    """Relative poses between nodes.

    first, second : (m,) nodes.  relative : (m, 3), of the second in the first's frame.  information : (m, 3, 3) there.
    robust : (m,) whether the edge may be wrong: it then loses weight as it disagrees.
    """

    first: IntArray
    second: IntArray
    relative: Array
    information: Array
    robust: NDArray[np.bool_]


class Solution(NamedTuple):
    """poses : (n, 3).  distances : (m,) squared Mahalanobis distance of each edge."""

    poses: Array
    distances: Array


def residuals(poses: Array, edges: Edges) -> tuple[Array, Array, Array]:
    """Errors (m, 3) of the edges and their derivatives (m, 3, 3) by the first and by the second pose."""
    a, b = poses[edges.first], poses[edges.second]
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    relative = se2.between(a, b)
    error = relative - edges.relative
    error[:, 2] = se2.wrap(error[:, 2])
    by_first, by_second = np.zeros((len(a), 3, 3)), np.zeros((len(a), 3, 3))
    by_second[:, 0, 0], by_second[:, 0, 1], by_second[:, 1, 0], by_second[:, 1, 1] = c, s, -s, c
    by_second[:, 2, 2] = 1.0
    by_first[:, :2, :2] = -by_second[:, :2, :2]
    by_first[:, 0, 2], by_first[:, 1, 2] = relative[:, 1], -relative[:, 0]
    by_first[:, 2, 2] = -1.0
    return error, by_first, by_second


def weighted(edges: Edges, error: Array) -> tuple[Array, Array]:
    """Squared distances (m,) of errors (m, 3), and the edges' information (m, 3, 3) times their robust weight."""
    distance = np.einsum("mi,mij,mj->m", error, edges.information, error)
    weight = np.where(edges.robust, 1.0 / (1.0 + distance / ROBUST_WIDTH), 1.0)
    return distance, edges.information * weight[:, None, None]


class RobustMeans(NamedTuple):
    """Of errors that are as their covariances tell: means of the robust weight w, and of w times the squared distance.

    gain : information of what robust least squares finds, over that of the weighted observations (Huber 1981, 7.6).
    """

    weight: float
    distance: float
    gain: float


@lru_cache
def robust_means(freedom: int) -> RobustMeans:
    """Means where the squared distance d is chi-square with so much freedom, by Gauss-Laguerre quadrature.

    Errors that are as the covariance tells lose weight too: without these means a variance that is found by weighted
    squares comes out too small, and the covariance of poses too large.
    """
    nodes, shares = roots_genlaguerre(40, freedom / 2 - 1)
    distance, shares = 2 * nodes, shares / shares.sum()
    weight = 1.0 / (1.0 + distance / ROBUST_WIDTH)
    mean, slope = float(shares @ weight), shares @ (weight - 2 * weight**2 * distance / ROBUST_WIDTH / freedom)
    scatter = shares @ (weight**2 * distance) / freedom
    return RobustMeans(mean, float(shares @ (weight * distance)), float(slope**2 / (scatter * mean)))


class Term(NamedTuple):
    """What some observations add to the normal equations.

    blocks : (rows, columns, values (k, a, b)) of the matrix.  sides : (rows, values (k, a)) of the right-hand side.
    distance : sum of the weighted squared Mahalanobis distances.  observations : their number, weighted.
    share : of the distance that the weights leave, for each observation, where errors are as the covariances tell.
    gain : see `RobustMeans`.
    """

    blocks: list[tuple[IntArray, IntArray, Array]]
    sides: list[tuple[IntArray, Array]]
    distance: float
    observations: float
    share: float
    gain: float


def edge_term(poses: Array, edges: Edges) -> Term:
    """What the edges say at these poses (n, 3)."""
    error, by_first, by_second = residuals(poses, edges)
    distance, weights = weighted(edges, error)
    weight = np.where(edges.robust, 1.0 / (1.0 + distance / ROBUST_WIDTH), 1.0)
    i, j = 3 * edges.first, 3 * edges.second
    first_w, second_w = np.swapaxes(by_first, 1, 2) @ weights, np.swapaxes(by_second, 1, 2) @ weights
    cross = first_w @ by_second
    blocks = [
        (i, i, first_w @ by_first),
        (j, j, second_w @ by_second),
        (i, j, cross),
        (j, i, np.swapaxes(cross, 1, 2)),
    ]
    sides = [(i, -np.einsum("mij,mj->mi", first_w, error)), (j, -np.einsum("mij,mj->mi", second_w, error))]
    total = float(weight.sum())
    means, robust = robust_means(3), float(weight[edges.robust].sum()) / max(total, 1e-300)
    share = 1.0 - robust * (1.0 - means.distance / (3 * means.weight))
    return Term(blocks, sides, float(weight @ distance), 3 * total, share, 1.0 + robust * (means.gain - 1.0))


def term_matrix(term: Term, size: int) -> sparse.csc_matrix:
    """Sparse (size, size) normal matrix of one term; blocks in one place add up."""
    values = [blocks.ravel() for _, _, blocks in term.blocks]
    places = [entries(*block) for block in term.blocks]
    rows, columns = (np.concatenate([place[k] for place in places]) for k in (0, 1))
    return sparse.csc_matrix((np.concatenate(values), (rows, columns)), shape=(size, size))


def entries(rows: IntArray, columns: IntArray, blocks: Array) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Row and column of each entry of blocks (k, a, b) that begin at `rows` and `columns` (k,)."""
    a, b = blocks.shape[1:]
    # Whole numbers as scipy has them, which else copies them.
    row = rows.astype(np.int32)[:, None] + np.repeat(np.arange(a, dtype=np.int32), b)
    column = columns.astype(np.int32)[:, None] + np.tile(np.arange(b, dtype=np.int32), a)
    return row.ravel(), column.ravel()


def add_side(side: Array, term: Term) -> None:
    """Add a term's right-hand side to `side`, in place."""
    for rows, values in term.sides:
        np.add.at(side, rows[:, None] + np.arange(values.shape[1]), values)


def factorise(matrix: sparse.csc_matrix) -> SuperLU:
    """Sparse factors of a symmetric positive definite matrix; BsmapError where it is singular."""
    try:
        return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    except RuntimeError as error:
        raise BsmapError("the pose graph falls into parts that nothing connects") from error


def optimise(poses: Array, edges: Edges) -> Solution:
    """Most probable poses (n, 3) under the edges, the first one held."""
    n = len(poses)
    poses = poses.copy()
    for _ in range(ITERATIONS):
        term = edge_term(poses, edges)
        matrix, side = term_matrix(term, 3 * n), np.zeros(3 * n)
        add_side(side, term)
        step = factorise(matrix[3:, 3:]).solve(side[3:]).reshape(-1, 3)
        poses[1:] += step
        poses[:, 2] = se2.wrap(poses[:, 2])
        if np.abs(step).max(initial=0.0) < 1e-4:
            break
    distance, _ = weighted(edges, residuals(poses, edges)[0])
    return Solution(poses, distance)
