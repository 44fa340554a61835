"""Banded linear least squares: rows with few neighbouring nonzeros, as B-spline basis functions give them.

A design matrix N is held as (first, values): row k is nonzero in the columns first[k] ... first[k] + b - 1 only. Then
N'N has b - 1 bands beside the diagonal, and so has its Cholesky factor. Several problems that share no column stand in
one system, block after block: it stays banded, and one factorisation serves them all.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve_banded, cholesky_banded
from scipy.sparse import csr_array

from bsmap_cli.errors import BsmapError
from bsmap_cli.model import Array

SINGULAR = 1e-8
"""Share of a column's square that must be its own."""


def normal_matrix(first: NDArray[np.intp], values: Array, columns: int) -> Array:
    """Lower bands (b, columns) of N'N: element [d, j] is (N'N)[j + d, j].

    Parameters
    ----------
    first : (n,) first column that is not zero in each row.  values : (n, b).
    """
    width = values.shape[1]
    bands = np.zeros((width, columns))
    for r in range(width):
        for d in range(width - r):
            bands[d] += np.bincount(first + r, values[:, r] * values[:, r + d], columns)
    return bands


def sparse_rows(first: NDArray[np.intp], values: Array, columns: int) -> csr_array:
    """The design matrix N (n, columns), for products with many columns."""
    n, width = values.shape
    indices = first[:, None] + np.arange(width)
    return csr_array((values.ravel(), indices.ravel(), np.arange(0, n * width + 1, width)), shape=(n, columns))


def factorise(normal: Array) -> Array:
    """Cholesky factor, lower bands (b, columns), of a normal matrix.

    Raises
    ------
    BsmapError
        Where the matrix is singular, or so nearly that half of the digits would be lost: some unknown has too few data
        (Schoenberg-Whitney).
    """
    try:
        factor = cholesky_banded(normal, lower=True)
    except LinAlgError:
        factor = None
    # The square of a pivot is what the unknowns before it leave of the column.
    if factor is None or np.any(factor[0] ** 2 < SINGULAR * normal[0]):
        message = f"least squares with {normal.shape[1]} unknowns is underdetermined: a knot span lacks data"
        raise BsmapError(message)
    return factor


def solve(factor: Array, right: Array) -> Array:
    """Solution (columns, k) of N'N X = right by the factor of `factorise`."""
    return cho_solve_banded((factor, True), right)


def fit(first: NDArray[np.intp], values: Array, data: Array, columns: int) -> tuple[Array, Array]:
    """Least-squares solution (columns, k) of N X = data (n, k), and the factor of N'N for more."""
    factor = factorise(normal_matrix(first, values, columns))
    return solve(factor, sparse_rows(first, values, columns).T @ data), factor


def block_variances(factor: Array, blocks: int, columns: NDArray[np.intp]) -> Array:
    """Diagonal elements (blocks, k) of (N'N)^-1 for unknowns `columns` (k,) of each of the equal, uncoupled blocks.

    The variance of an unknown where every datum has variance 1.
    """
    size = factor.shape[1] // blocks
    # One right side serves all blocks: a one in each of them.
    right = np.zeros((blocks, size, len(columns)))
    right[:, columns, np.arange(len(columns))] = 1.0
    solution = solve(factor, right.reshape(blocks * size, -1)).reshape(right.shape)
    return solution[:, columns, np.arange(len(columns))]
