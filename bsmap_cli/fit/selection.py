"""Which degrees and knots a height field gets: as many as the data pay for."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.heights import (
    Base,
    Feet,
    HeightField,
    Knots,
    basis_matrix,
    evaluate,
    find_feet,
    flat_knots,
    with_degree,
    with_knot,
)
from bsmap_cli.model import Array

PRICE = 5.0
"""Of a control point, in chi square: between Akaike's 2, which keeps the covariance honest, and the logarithm of the
number of data (BIC), which leaves gentle arcs flat."""
HIGHEST_DEGREE = 3
SMOOTH = 0.3
"""Metres: second differences of the heights are of this size or less. Only where there are no data does it matter."""
ROBUST = 3.0
"""Standard deviations beyond which a block counts less (Huber)."""
MOST = 400
"""Control points of one face."""


class Fitted(NamedTuple):
    """A height field with the information (k, k) of its heights, and its criterion."""

    field: HeightField
    information: Array
    criterion: float


class _Data(NamedTuple):
    """Feet, heights wanted there, roots of the weights, and numbers of distinct scans and beams."""

    feet: Feet
    wanted: Array
    root: Array


def fit_heights(blocks: Blocks, base: Base, low: Array, high: Array, sigma: float) -> Fitted:
    """Fit with the degrees and knots of the best criterion, found step by step from the least surface."""
    field = HeightField(base, low, high, flat_knots(), np.zeros((2, 2)))
    data = _linearise(field, blocks, sigma)
    best = _solve(field, field.knots, data)
    best = _solve(best.field, field.knots, data := _linearise(best.field, blocks, sigma))
    for _ in range(40):
        better = _improve(best, data)
        if better is None:
            break
        data = _linearise(better.field, blocks, sigma)
        best = _solve(better.field, better.field.knots, data)
    for _ in range(2):
        data = _linearise(best.field, blocks, sigma)
        best = _solve(best.field, best.field.knots, data)
    return best


def refit(field: HeightField, blocks: Blocks, sigma: float) -> Fitted:
    """Fit on the degrees and knots that a field has."""
    best = _solve(field, field.knots, _linearise(field, blocks, sigma))
    return _solve(best.field, field.knots, _linearise(best.field, blocks, sigma))


def _linearise(field: HeightField, blocks: Blocks, sigma: float) -> _Data:
    feet = find_feet(field, blocks.points, blocks.directions)
    wanted = evaluate(field, feet.uv)[0] - feet.slope * feet.beyond
    root = np.sqrt(blocks.counts) / sigma
    size = np.abs(feet.beyond) * root
    # What does not fit yet is no outlier: the scale is that of the residuals.
    scale = max(1.0, float(np.median(size)) / 0.6745)
    robust = np.sqrt(np.minimum(1.0, ROBUST * scale / np.maximum(size, 1e-12)))
    return _Data(feet, wanted, root * robust / np.abs(feet.slope))


def _solve(field: HeightField, knots: Knots, data: _Data) -> Fitted:
    """Least squares on given knots."""
    N = basis_matrix(knots, data.feet.uv) * data.root[:, None]
    y = data.wanted * data.root
    A = N.T @ N + smoothness(knots)
    scale = 1.0 / np.sqrt(np.diag(A))
    heights = scale * np.linalg.solve(A * scale[:, None] * scale + 1e-12 * np.eye(len(A)), scale * (N.T @ y))
    residual = N @ heights - y
    field = field._replace(knots=knots, heights=heights.reshape(knots.shape))
    return Fitted(field, A, float(residual @ residual) + PRICE * knots.size)


def smoothness(knots: Knots) -> Array:
    """Information of second differences of neighbouring heights (first mixed ones of a bilinear patch are free)."""
    ns, nt = knots.shape
    out = np.zeros((ns * nt, ns * nt))
    for rows in (np.kron(_second(ns), np.eye(nt)), np.kron(np.eye(ns), _second(nt))):
        out += rows.T @ rows / SMOOTH**2
    return out + 1e-6 / SMOOTH**2 * np.eye(len(out))


def _second(n: int) -> Array:
    return np.diff(np.eye(n), 2, axis=0) if n > 2 else np.zeros((1, n))


def _improve(best: Fitted, data: _Data) -> Fitted | None:
    """The best next step, or where none pays the best pair of steps; None where no pair pays, either."""
    singles = [_solve(best.field, knots, data) for knots in _moves(best.field, data)]
    if not singles:
        return None
    first = min(singles, key=lambda f: f.criterion)
    if first.criterion < best.criterion:
        return first
    pairs = [_solve(f.field, knots, data) for f in singles for knots in _moves(f.field, data)]
    if not pairs:
        return None
    second = min(pairs, key=lambda f: f.criterion)
    return second if second.criterion < best.criterion else None


def _moves(field: HeightField, data: _Data) -> Iterator[Knots]:
    """Knots with a higher degree along s or t, or with the span of most excess halved."""
    k = field.knots
    if k.size > MOST:
        return
    excess = (evaluate(field, data.feet.uv)[0] - data.wanted) ** 2 * data.root**2
    uv = np.clip(data.feet.uv, 0.0, 1.0)
    if _room(k.s, k.degree_s + 1, uv[:, 0]):
        if k.degree_s < HIGHEST_DEGREE:
            yield k._replace(degree_s=k.degree_s + 1, s=with_degree(k.s, k.degree_s))
        place = _worst_span(k.s, uv[:, 0], excess)
        if place is not None:
            yield k._replace(s=with_knot(k.s, k.degree_s, place))
    if _room(k.t, k.degree_t + 1, uv[:, 1]):
        if k.degree_t < HIGHEST_DEGREE:
            yield k._replace(degree_t=k.degree_t + 1, t=with_degree(k.t, k.degree_t))
        place = _worst_span(k.t, uv[:, 1], excess)
        if place is not None:
            yield k._replace(t=with_knot(k.t, k.degree_t, place))


def _room(knots: Array, order: int, u: Array) -> bool:
    """Whether the data stand at more places than there are control points along this direction."""
    return len(np.unique(np.round(u, 3))) > len(knots) - order + 1


def _worst_span(knots: Array, u: Array, excess: Array) -> float | None:
    """Middle of the span with most excess over its share, if both halves have data."""
    breaks = np.unique(knots)
    span = np.clip(np.searchsorted(breaks, u, side="right") - 1, 0, len(breaks) - 2)
    total = np.bincount(span, np.maximum(excess, 0.0) - 1.0, len(breaks) - 1)
    worst = int(np.argmax(total))
    middle = (breaks[worst] + breaks[worst + 1]) / 2.0
    inside = u[span == worst]
    if len(np.unique(np.round(inside, 3))) < 4 or not (inside < middle).any() or not (inside > middle).any():
        return None
    return float(middle)
