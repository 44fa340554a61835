"""Clamped knot vectors on [0, 1]: making, refining and cutting them, exactly.

The new control points of a refined or cut spline are a linear map of the old ones; the map is returned as a matrix, so
that it can be applied to control points, to their covariance, and along either direction of a surface.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bsmap_cli.model import Array

SNAP = 1e-12
"""Parameters closer than this to a knot count as the knot."""


class Refined(NamedTuple):
    """Knots, and matrix (n_new, n_old) from the old control points to the new ones."""

    knots: Array
    matrix: Array


def open_knots(degree: int) -> Array:
    """Knots of a single polynomial piece, (2 degree + 2,): zeros and ones only."""
    return clamped_knots(degree, ())


def clamped_knots(degree: int, interior: ArrayLike) -> Array:
    """Clamped knot vector on [0, 1] with the given inner knots, sorted; (len(interior) + 2 degree + 2,).

    Raises
    ------
    ValueError
        Where an inner knot lies outside (0, 1) or stands there more than `degree` times (the spline would tear).
    """
    inner = np.sort(np.asarray(interior, dtype=float))
    if len(inner) and not (inner[0] > 0.0 and inner[-1] < 1.0):
        raise ValueError(f"inner knots from {inner[0]} to {inner[-1]} are not inside (0, 1)")
    if len(inner) > degree and np.any(inner[degree:] == inner[:-degree]):
        raise ValueError(f"an inner knot stands more than {degree} times in a knot vector of degree {degree}")
    return np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])


def inner_knots(knots: Array, degree: int) -> Array:
    """Knots between the clamped ends."""
    return knots[degree + 1 : len(knots) - degree - 1]


def find_spans(knots: Array, degree: int, u: Array) -> NDArray[np.intp]:
    """Index mu of the span with knots[mu] <= u < knots[mu + 1] (the last one for u = 1), shape of `u`."""
    return np.searchsorted(inner_knots(knots, degree), u, side="right") + degree


class Triangle(NamedTuple):
    """Triangle of Cox and de Boor: levels[k] (k + 1, n), k = 0 ... degree, holds the functions of degree k.

    inverse_widths[k - 1] (k, n) are the reciprocals of the supports of the k functions of degree k - 1.
    """

    levels: list[Array]
    inverse_widths: list[Array]


def cox_de_boor(knots: Array, degree: int, spans: NDArray[np.intp], arguments: list[Array]) -> Triangle:
    """Functions of degree 0, 1, ..., `degree` that live on each span; row r of level k is function spans - k + r.

    Level k is evaluated at arguments[k - 1]. Equal arguments at all levels give the basis functions (Eq. 20); the
    knots of a refined vector give its discrete B-splines (Oslo algorithm).

    Parameters
    ----------
    knots : (m,)
    spans : (n,) index of the span of each evaluation.
    arguments : `degree` arrays (n,).
    """
    n = len(spans)
    # take() is several times faster than indexing; row i holds the knots spans + 1 - degree + i.
    local = knots.take(spans + np.arange(1 - degree, degree + 1)[:, None])
    levels, inverse_widths = [np.ones((1, n))], []
    for k in range(1, degree + 1):
        t, left, right = arguments[k - 1], local[degree - k : degree], local[degree : degree + k]
        inverse = 1.0 / (right - left)
        ratio = levels[-1] * inverse
        values = np.empty((k + 1, n))
        np.multiply(right - t, ratio, out=values[:k])
        values[k] = 0.0
        values[1:] += (t - left) * ratio
        levels.append(values)
        inverse_widths.append(inverse)
    return Triangle(levels, inverse_widths)


def insert_knots(knots: Array, degree: int, new_knots: ArrayLike) -> Refined:
    """Knots and matrix after inserting `new_knots` (Boehm 1980, Oslo algorithm): the shape stays exactly.

    Returns
    -------
    Refined: (m + k,) knots, (n + k, n) matrix with at most degree + 1 nonzeros a row; rows add up to one.
    """
    refined = clamped_knots(degree, np.concatenate([inner_knots(knots, degree), np.ravel(new_knots)]))
    return Refined(refined, _refinement_matrix(knots, degree, refined))


def restrict(knots: Array, degree: int, a: float, b: float) -> Refined:
    """Knots and matrix of the piece over [a, b], renormalised to [0, 1]: S_new(t) = S(a + (b - a) t) exactly.

    The covariance of the control points goes the same way, A C A'. Ends within 1e-12 of a knot are taken as the knot.

    Raises
    ------
    ValueError
        Unless 0 <= a < b <= 1.
    """
    if not (0.0 <= a < b <= 1.0):
        raise ValueError(f"[{a}, {b}] is not an interval inside [0, 1]")
    a, b = (float(knots[i]) if abs(knots[i] - x) < SNAP else x for x in (a, b) for i in [_nearest(knots, x)])
    inner = inner_knots(knots, degree)
    inner = inner[(inner > a) & (inner < b)]
    piece = np.concatenate([np.full(degree + 1, a), inner, np.full(degree + 1, b)])
    matrix = _refinement_matrix(knots, degree, piece)
    return Refined(clamped_knots(degree, (inner - a) / (b - a)), matrix)


def _nearest(knots: Array, x: float) -> int:
    return int(np.argmin(np.abs(knots - x)))


def _refinement_matrix(knots: Array, degree: int, refined: Array) -> Array:
    """Discrete B-splines alpha_i(j) of `knots` on `refined` (Cohen, Lyche, Riesenfeld 1980), (n_new, n_old)."""
    n_new, n_old = len(refined) - degree - 1, len(knots) - degree - 1
    rows = np.arange(n_new)
    spans = find_spans(knots, degree, refined[:n_new])
    values = cox_de_boor(knots, degree, spans, [refined[rows + k] for k in range(1, degree + 1)]).levels[-1]
    matrix = np.zeros((n_new, n_old))
    for r in range(degree + 1):
        matrix[rows, spans - degree + r] = values[r]
    return matrix
