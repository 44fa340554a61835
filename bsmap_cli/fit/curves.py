"""Least-squares B-spline curves through many rows of points on one knot vector, method.md section 7."""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import leastsquares
from bsmap_cli.core.bspline import basis_functions
from bsmap_cli.model import Array, IntArray


class Rows(NamedTuple):
    """Data of the curves, row after row, ascending in u within each row.

    u : (n,) parameters from 0 to 1.  row : (n,) number of the curve, 0 ... rows - 1, ascending.
    data : (n, k, 3), k points at each parameter, each of a curve of its own (k = 1 for plain curves), metres.
    allowance : (n, k) metres by which a point's error may exceed the bound: its noise.
    place : (n,) number of the parameter that a point shares with points of other rows, ascending in each row; None:
    the parameters are not to be moved.
    """

    u: Array
    row: IntArray
    data: Array
    allowance: Array
    place: IntArray | None = None

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return int(self.row[-1]) + 1 if len(self.row) else 0


class CurveFit(NamedTuple):
    """Curves on a common knot vector.

    knots : (n_control + degree + 1,).  control_points : (rows, n_control, k, 3).
    factor : (degree + 1, rows * n_control), Cholesky factor of all rows' N'N, block after block.
    residuals : (n, k, 3) metres, from the curve at its parameter to each data point.  errors : (n, k) their lengths.
    """

    knots: Array
    control_points: Array
    factor: Array
    residuals: Array
    errors: Array


def as_one_row(rows: Rows) -> Rows:
    """Rows as a single one of so many curves, which one factorisation serves, where all share their parameters."""
    count = rows.n_rows
    if rows.place is None or np.any(np.bincount(rows.row) != len(rows.u) / count):
        return rows
    u, place = rows.u.reshape(count, -1), rows.place.reshape(count, -1)
    if np.any(u != u[0]) or np.any(place != place[0]):
        return rows
    data, allowance = (
        np.ascontiguousarray(np.swapaxes(of.reshape(count, len(u[0]), *of.shape[2:]), 0, 1))
        for of in (rows.data, rows.allowance)
    )
    return Rows(u[0], np.zeros_like(place[0]), data, allowance, place[0])


def row_ends(row: IntArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices (rows,) of the first and the last point of each row, of row numbers (n,), ascending."""
    first = np.flatnonzero(np.diff(row, prepend=-1))
    return first, np.append(first[1:], len(row)) - 1


def centripetal(points: Array, row: IntArray) -> Array:
    """Centripetal parameters (n,), from 0 to 1 in each row, of points (n, 3): steps as sqrt of the chord lengths.

    A row whose points all coincide gets equal steps.
    """
    chords = np.sqrt(np.linalg.norm(np.diff(points, axis=0), axis=1))
    same_row = row[1:] == row[:-1]
    first, last = row_ends(row)
    counts = last - first + 1
    steps = np.concatenate([[0.0], np.where(same_row, chords, 0.0)])
    degenerate = np.repeat(np.add.reduceat(steps, first) <= 0.0, counts)
    steps = np.where(degenerate, 1.0, steps)
    steps[first] = 0.0
    along = np.cumsum(steps)
    along -= np.repeat(along[first], counts)
    total = np.where(along[last] > 0.0, along[last], 1.0)
    u = along / np.repeat(total, counts)
    u[last[counts > 1]] = 1.0
    return np.clip(u, 0.0, 1.0)


def fit_curves(rows: Rows, knots: Array, degree: int) -> CurveFit:
    """Least-squares curves of all rows on given knots, (N'N) P = N'Q, with one banded factorisation.

    Raises BsmapError where a span lacks data.
    """
    n_control = len(knots) - degree - 1
    first, values = basis_functions(knots, degree, rows.u)
    flat = rows.data.reshape(len(rows.u), -1)
    columns = rows.n_rows * n_control
    solution, factor = leastsquares.fit(first + rows.row * n_control, values[:, 0], flat, columns)
    control_points = solution.reshape(rows.n_rows, n_control, *rows.data.shape[1:])
    residuals = rows.data - evaluate_rows(rows, knots, degree, control_points)
    errors = np.sqrt(np.einsum("nkd,nkd->nk", residuals, residuals))
    return CurveFit(knots, control_points, factor, residuals, errors)


def evaluate_rows(rows: Rows, knots: Array, degree: int, control_points: Array, derivative: int = 0) -> Array:
    """Points (n, k, 3) of curves with control points (rows, n_control, k, 3) at all parameters, or derivatives."""
    first, values = basis_functions(knots, degree, rows.u, derivative)
    flat = control_points.reshape(-1, rows.data.shape[1] * 3)
    N = leastsquares.sparse_rows(first + rows.row * control_points.shape[1], values[:, derivative], len(flat))
    return np.asarray(N @ flat).reshape(rows.data.shape)


def schoenberg_whitney(knots: Array, degree: int, rows: Rows) -> bool:
    """Whether in each row some points u_i can be chosen, one for each control point, with t_i < u_i < t_{i+p+1}.

    The condition under which N'N is regular (Schoenberg and Whitney 1953). Choosing the lowest point left is enough.
    """
    n_control = len(knots) - degree - 1
    order = np.arange(n_control)
    lower, upper = knots[:n_control], knots[degree + 1 :]
    starts = np.searchsorted(rows.row, np.arange(rows.n_rows + 1))
    for start, stop in itertools.pairwise(starts):
        u = rows.u[start:stop]
        above = np.where(lower > 0.0, np.searchsorted(u, lower, side="right"), 0)
        chosen = order + np.maximum.accumulate(above - order)
        if chosen[-1] >= len(u) or not np.all((u[chosen] < upper) | (upper >= 1.0)):
            return False
    return True
