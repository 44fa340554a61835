"""Marginal covariances out of the smoothed information: columns of poses solved for, the rest by way of these."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.linalg import eigh
from scipy.sparse.linalg import SuperLU

from bsmap_cli.core.modes import LEAST_SHARE, LEVER, MOST_MODES, largest_positive
from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.posegraph import factorise

MOST_POSES = 200
"""Poses solved for exactly; those between them are interpolated, for neighbours err alike."""
COLUMNS, LINES = 24, 100
"""Columns solved for and lines looked at at once."""


class Marginals(NamedTuple):
    """poses : (n, 3, 3), of key poses in map, the first one 0.  lines : (m, 2, 2), of alpha, r.

    following : (n, 3, 3), covariance of each key pose (rows) with the next one (columns); 0 for the last.
    modes : (n, 3, k), what the poses' errors have in common, as in `Trajectory`.
    """

    poses: Array
    following: Array
    lines: Array
    modes: Array


def marginals(information: sparse.csc_matrix, poses: int, lines: int) -> Marginals:
    """Covariances of `poses` key poses and `lines` lines; the information is of all but the first pose."""
    if information.shape[0] == 0:
        none = np.zeros((poses, 3, 3))
        return Marginals(none, none, np.zeros((lines, 2, 2)), none[..., :0])
    at = np.unique(np.linspace(1, poses - 1, min(poses - 1, MOST_POSES)).astype(int)) if poses > 1 else np.zeros(0, int)
    factors = factorise(information)
    known = np.concatenate([[0], at])
    own, following, joint = _of_poses(factors, 3 * (at - 1), 3 * (poses - 2))
    every, after, modes = (_between(known, _with_first(part), poses) for part in (own, following, _modes(joint)))
    after[-1] = 0.0
    return Marginals(_symmetric(every), after, _symmetric(_of_lines(information, joint, at, poses)), modes)


def _of_lines(information: sparse.csc_matrix, joint: Array, at: IntArray, poses: int) -> Array:
    """(m, 2, 2) of the lines: what the poses that saw them leave, and what these are off by (Schur complement).

    joint : (3 k, 3 k) covariance of poses `at` (k,); those between err by shares of their neighbours' errors.
    """
    first = 3 * (poses - 1)
    of_lines = information[first:, first:]
    diagonal, beside = of_lines.diagonal(), of_lines.diagonal(1)[::2]
    left = np.linalg.inv(np.stack([diagonal[::2], beside, beside, diagonal[1::2]], axis=1).reshape(-1, 2, 2))
    if len(at) == 0:
        return left
    every = np.arange(1, poses)
    after = np.searchsorted(at, every).clip(min(1, len(at) - 1))
    before = np.maximum(after - 1, 0)
    share = np.where(after > before, (every - at[before]) / np.maximum(at[after] - at[before], 1), 1.0)
    rows, columns = np.tile(every - 1, 2), np.concatenate([before, after])
    shares = sparse.coo_array((np.concatenate([1.0 - share, share]), (rows, columns)), (poses - 1, len(at)))
    by_poses = sparse.csr_matrix(information[first:, :first] @ sparse.kron(shares, np.eye(3)))
    for start in range(0, len(left), LINES):  # the rows are dense, and there are many
        some = slice(start, start + LINES)
        rows = left[some] @ by_poses[2 * start : 2 * (start + LINES)].toarray().reshape(-1, 2, len(joint))
        left[some] += (rows @ joint) @ np.swapaxes(rows, 1, 2)
    return left


def _with_first(blocks: Array) -> Array:
    """The blocks (k, ...) after that of the first pose, which does not err."""
    return np.concatenate([np.zeros((1, *blocks.shape[1:])), blocks])


def _symmetric(blocks: Array) -> Array:
    return (blocks + np.swapaxes(blocks, 1, 2)) / 2


def _between(known: IntArray, blocks: Array, count: int) -> Array:
    """Blocks (count, a, b) of all from those (k, a, b) of some, linear between neighbours."""
    columns = [np.interp(np.arange(count), known, column) for column in blocks.reshape(len(known), -1).T]
    return np.array(columns).reshape(-1, count).T.reshape(count, *blocks.shape[1:])


def _of_poses(factors: SuperLU, starts: IntArray, last: int) -> tuple[Array, Array, Array]:
    """Blocks (k, 3, 3) of poses that begin at `starts` (k,), those with the next pose, and all of them (3 k, 3 k).

    last : beginning of the last pose, which has none after it: its own block stands there.
    """
    k = len(starts)
    own, following, joint = np.empty((k, 3, 3)), np.empty((k, 3, 3)), np.empty((k, 3, k, 3))
    for some, solved in _solved(factors, starts):
        joint[:, :, some] = solved[starts[:, None] + np.arange(3)]
        own[some] = _block(solved, starts[some])
        following[some] = _block(solved, np.minimum(starts[some] + 3, last))
    return own, following, joint.reshape(3 * k, 3 * k)


def _block(solved: Array, rows: IntArray) -> Array:
    """Blocks (j, 3, 3) of columns (n, j, 3), each in the rows that begin at `rows` (j,)."""
    axes = np.arange(3)
    return np.asarray(solved[rows[:, None, None] + axes, np.arange(len(rows))[:, None, None], axes[:, None]])


def _solved(factors: SuperLU, starts: IntArray) -> Iterator[tuple[slice, Array]]:
    """Columns (n, j, 3) of the inverse that begin at `starts` (k,), some at a time."""
    at_once = COLUMNS // 3
    for first in range(0, len(starts), at_once):
        some = slice(first, min(first + at_once, len(starts)))
        rows = starts[some, None] + np.arange(3)
        side = np.zeros((factors.shape[0], rows.size))
        side[rows.ravel(), np.arange(rows.size)] = 1.0
        yield some, factors.solve(side).reshape(-1, *rows.shape)


def _modes(joint: Array) -> Array:
    """(k, 3, modes) of the largest principal components of the poses' errors, from their covariance (3 k, 3 k)."""
    k = len(joint) // 3
    if k == 0:
        return np.zeros((0, 3, 0))
    scale = np.tile([1.0, 1.0, LEVER], k)
    largest = [max(3 * k - MOST_MODES, 0), 3 * k - 1]
    values, vectors = eigh((joint + joint.T) / 2 * scale * scale[:, None], subset_by_index=largest)
    kept = np.flatnonzero(values > LEAST_SHARE * max(joint.diagonal() @ scale**2, 1e-300))[::-1]
    vectors = largest_positive(vectors[:, kept] * np.sqrt(values[kept]))
    return (vectors / scale[:, None]).reshape(k, 3, len(kept))
