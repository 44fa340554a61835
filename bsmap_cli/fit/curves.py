"""Least-squares B-spline curves through many rows of points on one knot vector, method.md section 7.

The knot vector starts without inner knots and gets new ones where the error is worst, until the bound holds.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import leastsquares
from bsmap_cli.core.bspline import basis_functions, clamped_knots, inner_knots, open_knots
from bsmap_cli.errors import BsmapError
from bsmap_cli.model import Array, IntArray

LARGEST_VARIANCE = 10.0
"""Of a control point, where every data point has variance 1; with more, its data do not determine it.

Three times that where data are plenty, degree 3; beyond, it grows with the degree as the condition of the basis does.
"""
END_SHARE = 0.25
"""Of a span, that a new knot keeps away from either end."""

NARROW = 1e-9
"""Spans where the data of all rows leave less room than this get no more knots."""


class Rows(NamedTuple):
    """Data of the curves, row after row, ascending in u within each row.

    u : (n,) parameters from 0 to 1.  row : (n,) number of the curve, 0 ... rows - 1, ascending.
    data : (n, k, 3), k points at each parameter, each of a curve of its own (k = 1 for plain curves), metres.
    allowance : (n, k) metres by which a point's error may exceed the bound: its noise.
    """

    u: Array
    row: IntArray
    data: Array
    allowance: Array

    @property
    def n_rows(self) -> int:
        """Number of rows."""
        return int(self.row[-1]) + 1 if len(self.row) else 0


class CurveFit(NamedTuple):
    """Curves on a common knot vector.

    knots : (n_control + degree + 1,).  control_points : (rows, n_control, k, 3).
    factor : (degree + 1, rows * n_control), Cholesky factor of all rows' N'N, block after block.
    errors : (n, k) metres, distance of each data point to its curve at its parameter.
    """

    knots: Array
    control_points: Array
    factor: Array
    errors: Array


def centripetal(points: Array, row: IntArray) -> Array:
    """Centripetal parameters (n,), from 0 to 1 in each row, of points (n, 3): steps as sqrt of the chord lengths.

    A row whose points all coincide gets equal steps.
    """
    chords = np.sqrt(np.linalg.norm(np.diff(points, axis=0), axis=1))
    same_row = row[1:] == row[:-1]
    first = np.flatnonzero(np.concatenate([[True], ~same_row]))
    counts = np.diff(np.append(first, len(row)))
    steps = np.concatenate([[0.0], np.where(same_row, chords, 0.0)])
    degenerate = np.repeat(np.add.reduceat(steps, first) <= 0.0, counts)
    steps = np.where(degenerate, 1.0, steps)
    steps[first] = 0.0
    along = np.cumsum(steps)
    along -= np.repeat(along[first], counts)
    last = first + counts - 1
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
    values = values[:, 0]
    flat = rows.data.reshape(len(rows.u), -1)
    columns = rows.n_rows * n_control
    solution, factor = leastsquares.fit(first + rows.row * n_control, values, flat, columns)
    fitted = np.zeros_like(flat)
    for r in range(degree + 1):
        fitted += values[:, r, None] * solution[first + r + rows.row * n_control]
    errors = np.linalg.norm((fitted - flat).reshape(rows.data.shape), axis=2)
    control_points = solution.reshape(rows.n_rows, n_control, *rows.data.shape[1:])
    return CurveFit(knots, control_points, factor, errors)


def refine_curves(rows: Rows, degree: int, bound: float, knots_per_pass: int) -> CurveFit:
    """Curves with as many common knots as the bound needs, or as the data bear.

    Each pass inserts up to `knots_per_pass` knots at the parameters of the worst points over all rows, and fits again
    (the paper inserts one). It ends when no error exceeds `bound` and its allowance, or when no knot can be added
    without leaving some row's control points undetermined: then the bound lies below the noise, or a jump cannot be
    followed.

    We leave the paper in one point: a knot keeps a share of the span away from the span's ends. Where the worst point
    lies beside a knot, each pass would put the next knot beside the last one, and knots would creep along the curve.

    Raises BsmapError where a row has less than degree + 1 points.
    """
    fit = fit_curves(rows, open_knots(degree), degree)
    barred = np.zeros(len(rows.u), dtype=bool)
    while (excess := (fit.errors - rows.allowance).max(axis=1)).max() > bound:
        lowest, highest = _admissible_interval(rows, fit.knots)
        margin = END_SHARE * (highest - lowest)
        places = np.clip(rows.u, lowest + margin, highest - margin)
        candidates = np.flatnonzero((excess > bound) & (highest - lowest > NARROW) & ~barred)
        worst_first = candidates[np.argsort(-excess[candidates], kind="stable")]
        chosen = _choose(rows, fit.knots, degree, places, worst_first, knots_per_pass)
        if not chosen:
            break
        refined = _try(rows, fit.knots, degree, places[chosen])
        if refined is None and len(chosen) > 1:
            refined = _try(rows, fit.knots, degree, places[chosen[:1]])
        if refined is None:
            barred |= _same_span(rows, fit.knots, chosen[0])
        else:
            fit = refined
    return fit


def _try(rows: Rows, knots: Array, degree: int, new: Array) -> CurveFit | None:
    """Curves with new knots, or None where the data of some row do not determine the control points around them.

    Schoenberg-Whitney alone lets a curve swing wildly where a row has its points just inside the borders of a gap.
    """
    knots = _with(knots, degree, new)
    try:
        fit = fit_curves(rows, knots, degree)
    except BsmapError:
        return None
    around = np.searchsorted(knots, new)[:, None] + np.arange(-degree - 1, 1)
    columns = np.unique(np.clip(around, 0, len(knots) - degree - 2))
    variances = leastsquares.block_variances(fit.factor, rows.n_rows, columns)
    return fit if variances.max() <= LARGEST_VARIANCE * 3.0 ** max(0, degree - 3) else None


def _spans(rows: Rows, knots: Array) -> NDArray[np.intp]:
    """(n,) number of the span that holds each point; the last one holds its right end, too."""
    breaks = np.unique(knots)
    return np.minimum(np.searchsorted(breaks, rows.u, side="right"), len(breaks) - 1) - 1


def _same_span(rows: Rows, knots: Array, index: int) -> NDArray[np.bool_]:
    span = _spans(rows, knots)
    return span == span[index]


def _with(knots: Array, degree: int, new: Array) -> Array:
    return clamped_knots(degree, np.concatenate([inner_knots(knots, degree), new]))


def _choose(
    rows: Rows, knots: Array, degree: int, places: Array, candidates: NDArray[np.intp], count: int
) -> list[int]:
    """Up to `count` of the candidates, worst first, one a span, that may have knots at their places (n,)."""
    span = _spans(rows, knots)
    chosen: list[int] = []
    seen: set[int] = set()
    for index in candidates.tolist():
        if len(chosen) == count:
            break
        if int(span[index]) in seen:
            continue
        seen.add(int(span[index]))
        if schoenberg_whitney(_with(knots, degree, places[[*chosen, index]]), degree, rows):
            chosen.append(index)
    return chosen


def _admissible_interval(rows: Rows, knots: Array) -> tuple[Array, Array]:
    """For the span of each point, (n,) and (n,): a knot, lowest < knot <= highest, leaves every row data both sides."""
    span = _spans(rows, knots)
    spans = int(span.max()) + 1
    # Rows ascend in u, and every row has data in every span: the first of each (row, span) are in order.
    first = np.flatnonzero(np.diff(rows.row * spans + span, prepend=-1))
    last = np.append(first[1:], len(span)) - 1
    lowest = rows.u[first].reshape(-1, spans).max(axis=0)
    highest = rows.u[last].reshape(-1, spans).min(axis=0)
    return lowest[span], highest[span]


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
