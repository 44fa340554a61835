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
    """poses : (n, 3, 3), of key poses in map, the first one 0.  lines : (m, 2, 2), of alpha, r."""

    poses: Array
    lines: Array


def marginals(information: sparse.csc_matrix, poses: int, lines: int) -> Marginals:
    """Covariances of `poses` key poses and `lines` lines; the information is of all but the first pose."""
    at = np.unique(np.linspace(1, poses - 1, min(poses - 1, MOST_POSES)).astype(int)) if poses > 1 else np.zeros(0, int)
    if information.shape[0] == 0:
        return Marginals(np.zeros((poses, 3, 3)), np.zeros((lines, 2, 2)))
    factors = factorise(information)
    exact = np.concatenate([np.zeros((1, 3, 3)), _blocks(factors, 3 * (at - 1), 3)])
    known = np.concatenate([[0], at])
    every = [np.interp(np.arange(poses), known, column) for column in exact.reshape(-1, 9).T]
    first_line = 3 * (poses - 1)
    return Marginals(np.stack(every, axis=-1).reshape(-1, 3, 3), _blocks(factors, first_line + 2 * np.arange(lines), 2))


def _blocks(factors: SuperLU, starts: IntArray, size: int) -> Array:
    """Blocks (k, size, size) on the diagonal of the inverse, that begin at `starts` (k,)."""
    out = np.empty((len(starts), size, size))
    at_once = COLUMNS // size
    for first in range(0, len(starts), at_once):
        rows = starts[first : first + at_once, None] + np.arange(size)
        side = np.zeros((factors.shape[0], rows.size))
        side[rows.ravel(), np.arange(rows.size)] = 1.0
        solved = factors.solve(side).reshape(-1, *rows.shape)
        k = np.arange(len(rows))
        block = solved[rows[:, :, None], k[:, None, None], np.arange(size)]
        out[first : first + len(rows)] = (block + np.swapaxes(block, 1, 2)) / 2
    return out
