"""Basis functions of B-splines on clamped knots over [0, 1], and the surface that they carry."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bsmap_cli.core.knots import cox_de_boor, find_spans
from bsmap_cli.model import Array


class Surface(Protocol):
    """Tensor-product B-spline surface, Eq. (19); control_points : (nu, nv, d)."""

    @property
    def degree_u(self) -> int: ...
    @property
    def degree_v(self) -> int: ...
    @property
    def knots_u(self) -> Array: ...
    @property
    def knots_v(self) -> Array: ...
    @property
    def control_points(self) -> Array: ...


class TensorSpline(NamedTuple):
    """Bare geometry of a surface: knots_u (nu + p + 1,), knots_v (nv + q + 1,), control_points (nu, nv, d)."""

    degree_u: int
    degree_v: int
    knots_u: Array
    knots_v: Array
    control_points: Array


def basis_functions(
    knots: Array, degree: int, u: ArrayLike, derivatives: int = 0
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Basis functions that are not zero at each parameter, and their derivatives, Eq. (20-22).

    Parameters
    ----------
    knots : (m,) clamped knots.
    u : (n,) parameters in [0, 1]; the right end belongs to the last span.
    derivatives : highest order wanted.

    Returns
    -------
    first : (n,) number of the first function that is not zero.
    values : (n, derivatives + 1, degree + 1), values[:, d, r] the d-th derivative of function first + r.
    """
    u = np.asarray(u, dtype=float)
    spans = find_spans(knots, degree, u)
    return spans - degree, local_basis(knots, degree, spans, u, derivatives).transpose(2, 0, 1)


def local_basis(knots: Array, degree: int, spans: NDArray[np.intp], u: Array, derivatives: int) -> Array:
    """(derivatives + 1, degree + 1, n): values with the long axis last, where numpy is fastest."""
    levels, inverse_widths = cox_de_boor(knots, degree, spans, [u] * degree)
    values = np.zeros((derivatives + 1, degree + 1, len(u)))
    values[0] = levels[degree]
    for d in range(1, min(derivatives, degree) + 1):
        lower = levels[degree - d]
        for k in range(degree - d + 1, degree + 1):
            lower = _derivative(k, lower, inverse_widths[k - 1])
        values[d] = lower
    return values


def _derivative(k: int, lower: Array, inverse_widths: Array) -> Array:
    """Derivatives (k + 1, n) of the functions of degree k from values (k, n) of those of degree k - 1."""
    slopes = lower * inverse_widths
    slopes *= k
    result = np.empty((k + 1, slopes.shape[1]))
    np.negative(slopes, out=result[:k])
    result[k] = 0.0
    result[1:] += slopes
    return result


def design_matrix(knots: Array, degree: int, u: ArrayLike, derivative: int = 0) -> Array:
    """Dense matrix (n, n_control) of the basis functions at u: S(u) = N P."""
    first, values = basis_functions(knots, degree, u, derivative)
    columns = len(knots) - degree - 1
    if columns == degree + 1:  # a single span: all functions everywhere
        return np.ascontiguousarray(values[:, derivative])
    matrix = np.zeros((len(first), columns))
    begin = first + columns * np.arange(len(first))
    matrix.reshape(-1)[begin[:, None] + np.arange(degree + 1)] = values[:, derivative]
    return matrix
