"""Marginal covariances out of the smoothed information matrix, by solving for the columns that are asked for."""

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU

from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.posegraph import factorise

MOST_POSES = 300
"""Poses solved for exactly; those between them are interpolated, for neighbours err alike."""
COLUMNS = 120
"""Columns solved for at once."""


class Marginals(NamedTuple):
    """poses : (n, 3, 3), of key poses in map, the first one 0.  lines : (m, 2, 2), of alpha, r.

    following : (n, 3, 3), covariance of each key pose (rows) with the next one (columns); 0 for the last.
    """

    poses: Array
    following: Array
    lines: Array


def marginals(information: sparse.csc_matrix, poses: int, lines: int) -> Marginals:
    """Covariances of `poses` key poses and `lines` lines; the information is of all but the first pose."""
    at = np.unique(np.linspace(1, poses - 1, min(poses - 1, MOST_POSES)).astype(int)) if poses > 1 else np.zeros(0, int)
    if information.shape[0] == 0:
        return Marginals(np.zeros((poses, 3, 3)), np.zeros((poses, 3, 3)), np.zeros((lines, 2, 2)))
    factors = factorise(information)
    known, none = np.concatenate([[0], at]), np.zeros((1, 3, 3))
    starts = 3 * (at - 1)
    # The last pose has none after it: its own column stands there until it is set to 0.
    after = np.minimum(starts + 3, 3 * (poses - 2))
    exact = _blocks(factors, starts, np.stack([starts, after]), 3)
    every, following = (_between(known, np.concatenate([none, blocks]), poses) for blocks in exact)
    own = (every + np.swapaxes(every, 1, 2)) / 2
    following[-1] = 0.0
    first_line = 3 * (poses - 1) + 2 * np.arange(lines)
    (of_lines,) = _blocks(factors, first_line, first_line[None], 2)
    return Marginals(own, following, (of_lines + np.swapaxes(of_lines, 1, 2)) / 2)


def _between(known: IntArray, blocks: Array, count: int) -> Array:
    """Blocks (count, a, a) of all from those (k, a, a) of some, linear between neighbours."""
    columns = [np.interp(np.arange(count), known, column) for column in blocks.reshape(len(known), -1).T]
    return np.stack(columns, axis=-1).reshape(count, *blocks.shape[1:])


def _blocks(factors: SuperLU, starts: IntArray, columns: IntArray, size: int) -> Array:
    """Blocks (a, k, size, size) of the inverse, whose rows begin at `starts` (k,) and columns at `columns` (a, k)."""
    out = np.empty((*columns.shape, size, size))
    at_once = COLUMNS // size
    for first in range(0, len(starts), at_once):
        rows = starts[first : first + at_once, None] + np.arange(size)
        side = np.zeros((factors.shape[0], rows.size))
        side[rows.ravel(), np.arange(rows.size)] = 1.0
        solved = factors.solve(side).reshape(-1, *rows.shape)
        at = columns[:, first : first + at_once, None, None] + np.arange(size)
        k = np.arange(len(rows))[:, None, None]
        out[:, first : first + len(rows)] = solved[at, k, np.arange(size)[:, None]]
    return out
