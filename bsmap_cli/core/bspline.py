"""B-spline curves and surfaces on clamped knots over [0, 1]: basis functions, points, derivatives.

Free functions on arrays. A surface is anything with the attributes of `Surface`; `TensorSpline` is the smallest one.
The functions on knots are here, too, so that one import gives all of it.
"""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bsmap_cli.core.knots import (
    Refined,
    clamped_knots,
    cox_de_boor,
    find_spans,
    inner_knots,
    insert_knots,
    open_knots,
    restrict,
)
from bsmap_cli.model import Array

__all__ = [
    "Refined",
    "Surface",
    "TensorSpline",
    "basis_functions",
    "clamped_knots",
    "design_matrix",
    "evaluate_curve",
    "evaluate_grid",
    "evaluate_surface",
    "inner_knots",
    "insert_knots",
    "open_knots",
    "restrict",
]

CHUNK = 2048
"""Points evaluated at a time: their control points fit into the processor's cache."""

PARTIALS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Orders in u and v of the partial derivatives S, S_u, S_v, S_uu, S_uv, S_vv, in the order of `evaluate_surface`."""


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
    return spans - degree, np.moveaxis(_basis(knots, degree, spans, u, derivatives), 2, 0)


def _basis(knots: Array, degree: int, spans: NDArray[np.intp], u: Array, derivatives: int) -> Array:
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
    matrix = np.zeros((len(first), len(knots) - degree - 1))
    np.put_along_axis(matrix, first[:, None] + np.arange(degree + 1), values[:, derivative], axis=1)
    return matrix


def evaluate_curve(knots: Array, degree: int, control_points: Array, u: ArrayLike, derivatives: int = 0) -> Array:
    """Points of a curve and their derivatives, Eq. (23).

    Parameters
    ----------
    control_points : (n_control, d)
    u : (n,) parameters in [0, 1].

    Returns
    -------
    (n, d) points; with derivatives > 0 (derivatives + 1, n, d): points, first derivatives, and so on.
    """
    first, values = basis_functions(knots, degree, u, derivatives)
    local = control_points[first[:, None] + np.arange(degree + 1)]
    result = np.einsum("nkr,nrd->knd", values, local)
    return result if derivatives else result[0]


def evaluate_surface(surface: Surface, u: ArrayLike, v: ArrayLike, derivatives: int = 0) -> Array:
    """Points of a surface at scattered parameters, and their derivatives, Eq. (19).

    Parameters
    ----------
    u, v : (n,) parameters in [0, 1].
    derivatives : 0, 1 or 2, highest order wanted.

    Returns
    -------
    (n, d) points; with derivatives = 1 (3, n, d): S, S_u, S_v; with 2 (6, n, d): S, S_u, S_v, S_uu, S_uv, S_vv.
    """
    u, v = np.asarray(u, dtype=float), np.asarray(v, dtype=float)
    if u.ndim != 1 or u.shape != v.shape:
        raise ValueError(f"parameters u and v have shapes {u.shape} and {v.shape}, wanted (n,) both")
    partials = [orders for orders in PARTIALS if sum(orders) <= derivatives]
    # One contiguous plane a coordinate; results with the long axis last as well.
    planes = np.ascontiguousarray(np.moveaxis(surface.control_points, 2, 0))
    result = np.empty((len(partials), len(planes), len(u)))
    for start in range(0, len(u), CHUNK):
        part = slice(start, start + CHUNK)
        _evaluate_chunk(surface, planes, u[part], v[part], partials, result[:, :, part])
    points = np.moveaxis(result, 1, 2)
    return points if derivatives else points[0]


def _evaluate_chunk(
    surface: Surface, planes: Array, u: Array, v: Array, partials: list[tuple[int, int]], result: Array
) -> None:
    """Fill result (len(partials), d, n): contract along v for each local row of control points, then along u."""
    p, q = surface.degree_u, surface.degree_v
    highest = partials[-1][1]
    spans_u, spans_v = find_spans(surface.knots_u, p, u), find_spans(surface.knots_v, q, v)
    basis_u = _basis(surface.knots_u, p, spans_u, u, highest)
    basis_v = _basis(surface.knots_v, q, spans_v, v, highest)
    nv = planes.shape[2]
    corner = (spans_u - p) * nv + (spans_v - q)
    offsets = (np.arange(p + 1)[:, None] * nv + np.arange(q + 1)).ravel()
    local = planes.reshape(len(planes), -1).take(corner + offsets[:, None], axis=1)  # (d, (p+1)(q+1), n)
    local = local.reshape(len(planes), p + 1, q + 1, len(u))
    along_v = [np.einsum("dijn,jn->din", local, basis_v[order]) for order in range(highest + 1)]
    for row, (order_u, order_v) in enumerate(partials):
        np.einsum("din,in->dn", along_v[order_v], basis_u[order_u], out=result[row])


def evaluate_grid(surface: Surface, u: ArrayLike, v: ArrayLike) -> Array:
    """Points of a surface at all pairs of parameters u (n,) and v (m,): (n, m, d)."""
    along_u = design_matrix(surface.knots_u, surface.degree_u, u)
    along_v = design_matrix(surface.knots_v, surface.degree_v, v)
    planes = np.moveaxis(surface.control_points, 2, 0)
    return np.moveaxis(along_u @ planes @ along_v.T, 0, 2)
