"""Which knots curves get, method.md sections 7 and 10: many a pass where errors exceed the bound, then as few as hold.

The knot vector starts without inner knots. Where points share parameters, these move with every new fit.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter1d

from bsmap_cli.core import leastsquares
from bsmap_cli.core.bspline import clamped_knots, design_matrix, inner_knots, open_knots
from bsmap_cli.errors import BsmapError
from bsmap_cli.fit.alignment import common_steps, moved
from bsmap_cli.fit.curves import CurveFit, Rows, evaluate_rows, fit_curves, row_ends, schoenberg_whitney
from bsmap_cli.model import Array

LARGEST_VARIANCE = 10.0
"""Of a control point, where every data point has variance 1; with more, its data do not determine it.

Three times that where data are plenty, degree 3; beyond, it grows with the degree as the condition of the basis does.
"""
END_SHARE = 0.25
"""Of a span, that a new knot keeps away from either end."""
NARROW = 1e-9
"""Spans where the data of all rows leave less room than this get no more knots."""
MOVES = 3
"""Of the shared parameters, after each change of knots."""
AROUND = 11
"""Points among which the largest error is the limit where the bound does not hold."""
SLACK = 0.8
"""Of a bound, to which knots are left out: the rest is for moving the parameters on the finished surface."""
AT_ONCE = 0.3
"""Share of the inner knots that may leave at once."""


class Refined(NamedTuple):
    """Curves, and the rows with the parameters at which they were fitted."""

    rows: Rows
    fit: CurveFit

    @property
    def excess(self) -> Array:
        """(n,) metres by which a point's error exceeds its allowance, the worst of its k."""
        return np.asarray((self.fit.errors - self.rows.allowance).max(axis=1))


def refine_curves(rows: Rows, degree: int, bound: float, knots_per_pass: int) -> Refined:
    """Curves with as few common knots as the bound needs, or as the data bear.

    Raises BsmapError where a row has less than degree + 1 points.
    """
    now = _settled(Refined(rows, fit_curves(rows, open_knots(degree), degree)), degree)
    return _thinned(_inserted(now, degree, bound, knots_per_pass), degree, bound)


def _settled(now: Refined, degree: int) -> Refined:
    """Curves with the parameters, where they may move, moved to them as long as errors fall."""
    if now.rows.place is None:
        return now
    place = np.broadcast_to(now.rows.place[:, None], now.rows.allowance.shape)
    for _ in range(MOVES):
        tangents = evaluate_rows(now.rows, now.fit.knots, degree, now.fit.control_points, 1)
        rows = moved(now.rows, common_steps(place, tangents, now.fit.residuals))
        try:
            fit = fit_curves(rows, now.fit.knots, degree)
        except BsmapError:
            break
        if np.sum(fit.errors**2) >= np.sum(now.fit.errors**2):
            break
        now = Refined(rows, fit)
    return now


def _inserted(now: Refined, degree: int, bound: float, knots_per_pass: int) -> Refined:
    """Curves with knots inserted until the bound holds.

    Each pass inserts up to `knots_per_pass` knots at the parameters of the worst points over all rows, and fits again
    (the paper inserts one). It ends when no error exceeds `bound` and its allowance, or when no knot can be added
    without leaving some row's control points undetermined: then the bound lies below the noise, or a jump cannot be
    followed.

    We leave the paper in one point: a knot keeps a share of the span away from the span's ends. Where the worst point
    lies beside a knot, each pass would put the next knot beside the last one, and knots would creep along the curve.
    """
    barred = np.zeros(len(now.rows.u), dtype=bool)
    while (excess := now.excess).max() > bound:
        rows, knots = now.rows, now.fit.knots
        lowest, highest = _admissible_interval(rows, knots)
        margin = END_SHARE * (highest - lowest)
        places = np.clip(rows.u, lowest + margin, highest - margin)
        candidates = np.flatnonzero((excess > bound) & (highest - lowest > NARROW) & ~barred)
        worst_first = candidates[np.argsort(-excess[candidates], kind="stable")]
        chosen = _choose(rows, knots, degree, places, worst_first, knots_per_pass)
        if not chosen:
            break
        refined = _try(rows, knots, degree, places[chosen])
        if refined is None and len(chosen) > 1:
            refined = _try(rows, knots, degree, places[chosen[:1]])
        if refined is None:
            barred |= _same_span(rows, knots, chosen[0])
        else:
            now = refined
    return now


def _thinned(now: Refined, degree: int, bound: float) -> Refined:
    """Curves without the knots that the bound does not need, those first that matter least to the sum of squares.

    Where the bound does not hold, errors may not grow beyond those around them.
    """
    limit = np.maximum(SLACK * bound, maximum_filter1d(now.excess, AROUND))
    needed: set[float] = set()
    share = AT_ONCE
    while True:
        inner = inner_knots(now.fit.knots, degree)
        free = np.array([t not in needed for t in inner.tolist()], dtype=bool)
        if not free.any():
            return now
        loss = np.where(free, _losses(now.fit, degree), np.inf)
        gone = _apart(loss, max(1, int(share * np.count_nonzero(free))))
        thinner = _without(now, clamped_knots(degree, np.delete(inner, gone)), degree, limit)
        if thinner is not None:
            now = thinner
        elif len(gone) > 1:
            share /= 2
        else:
            needed.add(float(inner[gone[0]]))


def _without(now: Refined, knots: Array, degree: int, limit: Array) -> Refined | None:
    """Curves on fewer knots, or None where some error is over its limit (n,)."""
    thinner = Refined(now.rows, fit_curves(now.rows, knots, degree))
    excess = thinner.excess - limit
    settled = _settled(thinner, degree)
    if np.all(settled.excess <= limit):
        return settled
    return thinner if excess.max() <= 0.0 else None


def _losses(fit: CurveFit, degree: int) -> Array:
    """Growth (k,) of the sum of squares when one of the k inner knots is left out.

    Without it the highest derivative does not jump there: a linear constraint j'P = 0 on the control points of each
    row, at the price (j'P)^2 / j'(N'N)^-1 j.
    """
    inner = np.unique(inner_knots(fit.knots, degree))
    breaks = np.concatenate([[0.0], inner, [1.0]])
    J = np.diff(design_matrix(fit.knots, degree, (breaks[1:] + breaks[:-1]) / 2, degree), axis=0)
    rows, n_control = fit.control_points.shape[:2]
    jumps = np.einsum("kc,rcx->rkx", J, fit.control_points.reshape(rows, n_control, -1))
    right = np.tile(J.T, (rows, 1))
    variances = np.einsum("kc,rck->rk", J, leastsquares.solve(fit.factor, right).reshape(rows, n_control, -1))
    return np.asarray((np.einsum("rkx,rkx->rk", jumps, jumps) / variances).sum(axis=0))


def _apart(loss: Array, count: int) -> NDArray[np.intp]:
    """Up to `count` knots of the least loss (k,), no two of them neighbours."""
    chosen: list[int] = []
    for index in np.argsort(loss, kind="stable").tolist():
        if len(chosen) == count or not np.isfinite(loss[index]):
            break
        if index - 1 not in chosen and index + 1 not in chosen:
            chosen.append(index)
    return np.array(chosen, dtype=np.intp)


def _try(rows: Rows, knots: Array, degree: int, new: Array) -> Refined | None:
    """Curves with new knots, or None where the data of some row do not determine the control points around them.

    Schoenberg-Whitney alone lets a curve swing wildly where a row has its points just inside the borders of a gap.
    """
    knots = _with(knots, degree, new)
    try:
        now = _settled(Refined(rows, fit_curves(rows, knots, degree)), degree)
    except BsmapError:
        return None
    around = np.searchsorted(knots, new)[:, None] + np.arange(-degree - 1, 1)
    columns = np.unique(np.clip(around, 0, len(knots) - degree - 2))
    variances = leastsquares.block_variances(now.fit.factor, rows.n_rows, columns)
    return now if variances.max() <= LARGEST_VARIANCE * 3.0 ** max(0, degree - 3) else None


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
    _, firsts = np.unique(span[candidates], return_index=True)
    chosen: list[int] = []
    for index in candidates[np.sort(firsts)].tolist():
        if len(chosen) == count:
            break
        if schoenberg_whitney(_with(knots, degree, places[[*chosen, index]]), degree, rows):
            chosen.append(index)
    return chosen


def _admissible_interval(rows: Rows, knots: Array) -> tuple[Array, Array]:
    """For the span of each point, (n,) and (n,): a knot, lowest < knot <= highest, leaves every row data both sides."""
    span = _spans(rows, knots)
    first, last = row_ends(rows.row * len(rows.u) + span)
    # A row may have moved all its data out of a span: no knot is admissible there.
    lowest, highest, rows_in = np.zeros(span.max() + 1), np.ones(span.max() + 1), np.bincount(span[first])
    np.maximum.at(lowest, span[first], rows.u[first])
    np.minimum.at(highest, span[last], rows.u[last])
    highest = np.where(rows_in < rows.n_rows, lowest, highest)
    return lowest[span], highest[span]
