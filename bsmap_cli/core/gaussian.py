"""Gaussian estimates: gates, normalised squared errors, products of densities, packed symmetric matrices."""

from functools import lru_cache

import numpy as np

from bsmap_cli.errors import BsmapError
from bsmap_cli.model import Array

# Order of the six terms of a packed symmetric 3x3 matrix: xx, xy, xz, yy, yz, zz.
_ROW, _COLUMN = np.triu_indices(3)


@lru_cache(maxsize=4096)
def chi2_gate(probability: float, dof: int) -> float:
    """Quantile of the chi-square distribution: a true pair's squared distance is below it with `probability`."""
    from scipy.special import chdtri

    return float(chdtri(dof, 1.0 - probability))


def noncentrality(square: float, dof: float) -> float:
    """Mean of what the noncentrality of a chi square of `dof` degrees of freedom, seen as `square`, may be.

    All of them alike likely before. The density is a Poisson mixture of central ones (Johnson, Kotz and Balakrishnan,
    Continuous Univariate Distributions 2, chapter 29), term by term integrable: 2 (1 + mean of j), weights
    (square / 2)^j / Gamma(dof / 2 + j).
    """
    half, weight, total, mean, j = 0.5 * square, 1.0, 1.0, 0.0, 0
    while weight > 1e-9 * total or 0.5 * dof + j < half:
        weight *= half / (0.5 * dof + j)
        j += 1
        total, mean = total + weight, mean + j * weight
        if total > 1e200:
            weight, total, mean = weight / total, 1.0, mean / total
    return 2.0 * (1.0 + mean / total)


def pack(matrices: Array) -> Array:
    """Symmetric matrices (..., 3, 3) as (..., 6): xx, xy, xz, yy, yz, zz."""
    return matrices[..., _ROW, _COLUMN]


def unpack(terms: Array) -> Array:
    """Six terms (..., 6) as symmetric matrices (..., 3, 3)."""
    out = np.empty((*terms.shape[:-1], 3, 3))
    out[..., _ROW, _COLUMN] = terms
    out[..., _COLUMN, _ROW] = terms
    return out


def symmetric_sqrt(matrices: Array) -> Array:
    """Symmetric positive semidefinite square roots of (..., 3, 3); negative eigenvalues of rounding count as 0."""
    values, vectors = np.linalg.eigh(matrices)
    roots = np.sqrt(np.maximum(values, 0.0))
    return np.einsum("...ik,...k,...jk->...ij", vectors, roots, vectors)


def rounded_root(covariance: Array, unit: float, least: float) -> Array | None:
    """Lower triangular root L (n, n), in whole units, of a covariance (n, n); None where it is nearly singular.

    Cholesky's method, each column rounded before the next ones are found, so that these make up for it. The root of
    L L' is L. What is left of a variance, given those before it, is to be `least` units squared or more.
    """
    left = np.rint(covariance / unit**2)
    root = np.zeros_like(left)
    for k in range(len(left)):
        pivot = np.rint(np.sqrt(max(left[k, k], 0.0)))
        if pivot < least:
            return None
        root[k, k] = pivot
        root[k + 1 :, k] = np.rint(left[k + 1 :, k] / pivot)
        left -= np.outer(root[:, k], root[:, k])
    return root


def squared_distance(difference: Array, covariance: Array) -> Array:
    """Squared Mahalanobis distances (...,) of differences (..., k) under covariances (..., k, k)."""
    try:
        solved = np.linalg.solve(covariance, difference[..., None])[..., 0]
    except np.linalg.LinAlgError as error:
        raise BsmapError("a covariance is singular where a distance is measured by it") from error
    return np.einsum("...k,...k->...", difference, solved)


def squared_distance_2(difference: Array, covariance: Array) -> Array:
    """The same for differences (..., 2), by Cramer's rule: for a few, a third of the time."""
    x, y = difference[..., 0], difference[..., 1]
    a, b, d = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return (d * x * x - 2 * b * x * y + a * y * y) / (a * d - b * b)


def product(a: Array, a_covariance: Array, b: Array, b_covariance: Array) -> tuple[Array, Array]:
    """Product of two Gaussian densities, Eq. (37-38): means (..., k), covariances (..., k, k)."""
    gain = np.swapaxes(np.linalg.solve(a_covariance + b_covariance, a_covariance), -1, -2)
    mean = a + np.einsum("...ij,...j->...i", gain, b - a)
    covariance = a_covariance - gain @ a_covariance
    return mean, (covariance + np.swapaxes(covariance, -1, -2)) / 2
