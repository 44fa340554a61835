"""Surfaces as polynomial pieces, one a pair of spans: the quick way to many points of one surface.

The Taylor coefficients about the middle of every piece are computed once. A point then costs a search of its two spans,
a gather of its coefficients and Horner's scheme, which gives the derivatives by the way.
"""

from functools import lru_cache
from math import factorial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.basis import Surface, basis_functions
from bsmap_cli.model import Array

CHUNK = 2048
"""Points evaluated at a time: their coefficients fit into the processor's cache."""
MOST_BINS = 4096
"""Longest table of spans, several times quicker than a search among random parameters."""


class Spans(NamedTuple):
    """The k spans along one direction; a span's own parameter runs from -1 to 1.

    inner : (k,) the knots between them, and infinity.  middle : (k,).  scale : (k,) change of the span's own parameter.
    table : (bins + 1,) span at the beginning of equal bins, none of which holds two knots; empty where that takes
    too many.
    """

    inner: Array
    middle: Array
    scale: Array
    table: NDArray[np.intp]

    def find(self, u: Array) -> NDArray[np.intp]:
        """Number (n,) of the span of each parameter; a knot belongs to the span that begins there."""
        if not len(self.table):
            return self.inner.searchsorted(u, side="right")
        number = self.table.take((u * (len(self.table) - 1)).astype(np.intp), mode="clip")
        number += u >= self.inner.take(number)
        return number


class Pieces(NamedTuple):
    """Polynomial pieces of a surface; coefficients : (q + 1, p + 1, d, ku kv), those of v outside, v fastest."""

    along_u: Spans
    along_v: Spans
    coefficients: Array


def polynomial_pieces(surface: Surface) -> Pieces:
    """Taylor coefficients of all pieces of a surface about their middles."""
    along_u, to_u = _expansion(np.asarray(surface.knots_u, dtype=np.float64).tobytes(), surface.degree_u)
    along_v, to_v = _expansion(np.asarray(surface.knots_v, dtype=np.float64).tobytes(), surface.degree_v)
    nu, nv, d = surface.control_points.shape
    rows = (to_u @ surface.control_points.reshape(nu, -1)).reshape(-1, nv, d)
    ku, kv = len(along_u.middle), len(along_v.middle)
    grid = (to_v @ rows).reshape(ku, surface.degree_u + 1, kv, surface.degree_v + 1, d)
    coefficients = np.ascontiguousarray(grid.transpose(3, 1, 4, 0, 2))
    return Pieces(along_u, along_v, coefficients.reshape(*coefficients.shape[:3], ku * kv))


@lru_cache(maxsize=256)
def _expansion(packed: bytes, degree: int) -> tuple[Spans, Array]:
    """Spans, and the matrix (k (degree + 1), n_control) from control points to the coefficients of each.

    packed : the knots as float64; the same few return in many surfaces.
    """
    knots = np.frombuffer(packed)
    ends = np.unique(knots)
    middle, half = (ends[1:] + ends[:-1]) / 2, np.diff(ends) / 2
    first, values = basis_functions(knots, degree, middle, degree)
    orders = np.arange(degree + 1)
    values = values * (half[:, None] ** orders / [factorial(order) for order in orders])[:, :, None]
    matrix = np.zeros((len(middle), degree + 1, len(knots) - degree - 1))
    np.put_along_axis(matrix, first[:, None, None] + np.broadcast_to(orders, values.shape), values, axis=2)
    inner = np.append(ends[1:-1], np.inf)
    # Powers of two: the beginnings of the bins are exact.
    bins = 2 ** int(np.ceil(np.log2(1.0 / np.diff(ends).min())))
    table = inner.searchsorted(np.arange(bins + 1) / bins, side="right") if bins <= MOST_BINS else np.empty(0, np.intp)
    return Spans(inner, middle, 1.0 / half, table), matrix.reshape(-1, matrix.shape[2])


def evaluate_pieces(pieces: Pieces, u: Array, v: Array, derivatives: int = 0) -> Array:
    """Points of a surface at parameters u, v (n,) in [0, 1], and their partial derivatives.

    Returns
    -------
    (1, d, n), (3, d, n) or (6, d, n) for derivatives = 0, 1, 2: S, S_u, S_v, S_uu, S_uv, S_vv, the long axis last.
    """
    result = np.empty(((1, 3, 6)[derivatives], pieces.coefficients.shape[2], len(u)))
    for start in range(0, len(u), CHUNK):
        part = slice(start, start + CHUNK)
        _evaluate_chunk(pieces, u[part], v[part], derivatives, result[:, :, part])
    return result


def _evaluate_chunk(pieces: Pieces, u: Array, v: Array, derivatives: int, result: Array) -> None:
    i, x, du = _place(pieces.along_u, u)
    j, y, dv = _place(pieces.along_v, v)
    i *= len(pieces.along_v.middle)
    i += j
    along_v = _taylor(pieces.coefficients.take(i, axis=3), y, derivatives)  # (derivatives + 1, p + 1, d, n)
    along_u = _taylor(along_v.swapaxes(0, 1), x, derivatives, crossed=True)
    result[0] = along_u[0, 0]
    if derivatives:
        np.multiply(along_u[1, 0], du, out=result[1])
        np.multiply(along_u[0, 1], dv, out=result[2])
    if derivatives > 1:
        np.multiply(along_u[2, 0], 2 * du * du, out=result[3])
        np.multiply(along_u[1, 1], du * dv, out=result[4])
        np.multiply(along_u[0, 2], 2 * dv * dv, out=result[5])


def horner(coefficients: Array, x: Array, y: Array) -> tuple[Array, Array, Array]:
    """Values (n,) and derivatives by x and y of polynomials with coefficients (q + 1, p + 1, n), those of y outside."""
    along = _taylor(_taylor(coefficients, y, 1).swapaxes(0, 1), x, 1, crossed=True)
    return along[0, 0], along[1, 0], along[0, 1]


def _place(spans: Spans, u: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """Number of the span of each parameter, the span's own parameter, and its change."""
    number = spans.find(u)
    scale = spans.scale.take(number)
    local = u - spans.middle.take(number)
    local *= scale
    return number, local, scale


def _taylor(coefficients: Array, x: Array, highest: int, crossed: bool = False) -> Array:
    """Polynomials with coefficients (degree + 1, m, ..., n) at x (n,), Horner's scheme repeated.

    Returns
    -------
    (highest + 1, m, ..., n): values, first derivatives, halves of the second derivatives. `crossed`: of the m only
    those are needed, and right, whose number and that of the derivative are at most `highest` together.
    """
    degree, many = len(coefficients) - 1, coefficients.shape[1]
    result = np.zeros((highest + 1, *coefficients.shape[1:]))
    np.multiply(coefficients[degree], x, out=result[0])
    result[0] += coefficients[degree - 1]
    if highest:
        result[1] = coefficients[degree]
    for done in range(2, degree + 1):
        for order in range(min(highest, done), 0, -1):
            part = slice(highest + 1 - order if crossed else many)
            if order < done:
                result[order, part] *= x
            result[order, part] += result[order - 1, part]
        result[0] *= x
        result[0] += coefficients[degree - done]
    return result
