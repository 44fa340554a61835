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
    every = _between(known, np.concatenate([none, _blocks(factors, starts, starts, 3)]), poses)
    own = (every + np.swapaxes(every, 1, 2)) / 2
    # The last pose has none after it: its own column stands there until it is set to 0.
    after = np.minimum(starts + 3, 3 * (poses - 2))
    following = _between(known, np.concatenate([none, _blocks(factors, starts, after, 3)]), poses)
    following[-1] = 0.0
    first_line = 3 * (poses - 1) + 2 * np.arange(lines)
    of_lines = _blocks(factors, first_line, first_line, 2)
    return Marginals(own, following, (of_lines + np.swapaxes(of_lines, 1, 2)) / 2)


def _between(known: IntArray, blocks: Array, count: int) -> Array:
    """Blocks (count, a, a) of all from those (k, a, a) of some, linear between neighbours."""
    columns = [np.interp(np.arange(count), known, column) for column in blocks.reshape(len(known), -1).T]
    return np.stack(columns, axis=-1).reshape(count, *blocks.shape[1:])


def _blocks(factors: SuperLU, starts: IntArray, after: IntArray, size: int) -> Array:
    """Blocks (k, size, size) of the inverse, whose rows begin at `starts` and columns at `after` (k,)."""
    out = np.empty((len(starts), size, size))
    at_once = COLUMNS // size
    for first in range(0, len(starts), at_once):
        rows, columns = (at[first : first + at_once, None] + np.arange(size) for at in (starts, after))
        side = np.zeros((factors.shape[0], rows.size))
        side[rows.ravel(), np.arange(rows.size)] = 1.0
        solved = factors.solve(side).reshape(-1, *rows.shape)
        k = np.arange(len(rows))
        out[first : first + len(rows)] = solved[columns[:, None, :], k[:, None, None], np.arange(size)[:, None]]
    return out
