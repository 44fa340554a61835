"""Which degrees and knots a height field gets: as many as the data pay for."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import design_matrix
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.heights import (
    Base,
    Feet,
    HeightField,
    Knots,
    evaluate,
    find_feet,
    least_knots,
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
    """Feet (n,) of the blocks, heights wanted there, roots of the weights.

    places : along s and t, number of distinct parameters, to a thousandth.
    bases : basis functions at the feet that were computed so far, by direction, degree and knots.
    """

    feet: Feet
    wanted: Array
    root: Array
    places: tuple[int, int]
    bases: dict[tuple[int, int, bytes], Array]

    def basis(self, axis: int, degree: int, knots: Array) -> Array:
        """(n, k) basis functions along s (0) or t (1)."""
        key = axis, degree, knots.tobytes()
        if key not in self.bases:
            self.bases[key] = design_matrix(knots, degree, np.clip(self.feet.uv[:, axis], 0.0, 1.0))
        return self.bases[key]


class _Trial(NamedTuple):
    """A fit with the chi square (n,) of each block."""

    fitted: Fitted
    misfit: Array


def fit_heights(blocks: Blocks, base: Base, low: Array, high: Array, sigma: float) -> Fitted:
    """Fit with the degrees and knots of the best criterion, found step by step from the least surface."""
    knots = least_knots(base)
    field = HeightField(base, low, high, knots, np.zeros(knots.shape))
    best = _solve(field, field.knots, _linearise(field, blocks, sigma)).fitted
    data = _linearise(best.field, blocks, sigma)
    trial = _solve(best.field, field.knots, data)
    for _ in range(40):
        better = _improve(trial, data)
        if better is None:
            break
        data = _linearise(better, blocks, sigma)
        trial = _solve(better, better.knots, data)
    return refit(trial.fitted.field, blocks, sigma)


def refit(field: HeightField, blocks: Blocks, sigma: float) -> Fitted:
    """Fit on the degrees and knots that a field has."""
    for _ in range(2):
        best = _solve(field, field.knots, _linearise(field, blocks, sigma)).fitted
        field = best.field
    return best


def _linearise(field: HeightField, blocks: Blocks, sigma: float) -> _Data:
    feet = find_feet(field, blocks.points, blocks.directions)
    wanted = evaluate(field, feet.uv)[0] - feet.slope * feet.beyond
    root = np.sqrt(blocks.counts) / sigma
    size = np.abs(feet.beyond) * root
    # What does not fit yet is no outlier: the scale is that of the residuals.
    scale = max(1.0, float(np.median(size)) / 0.6745)
    robust = np.sqrt(np.minimum(1.0, ROBUST * scale / np.maximum(size, 1e-12)))
    places = _places(feet.uv[:, 0]), _places(feet.uv[:, 1])
    return _Data(feet, wanted, root * robust / np.abs(feet.slope), places, {})


def _places(u: Array) -> int:
    """Number of distinct parameters (n,), clamped to [0, 1], to a thousandth."""
    return int(np.count_nonzero(np.bincount(np.rint(np.clip(u, 0.0, 1.0) * 1000.0).astype(np.int64))))


def _solve(field: HeightField, knots: Knots, data: _Data) -> _Trial:
    """Least squares on given knots."""
    along_s = data.basis(0, knots.degree_s, knots.s) * data.root[:, None]
    along_t = data.basis(1, knots.degree_t, knots.t)
    N = (along_s[:, :, None] * along_t[:, None, :]).reshape(len(along_s), -1)
    y = data.wanted * data.root
    A = N.T @ N + smoothness(knots)
    scale = 1.0 / np.sqrt(A.diagonal())
    scaled = A * scale[:, None] * scale
    scaled.flat[:: len(A) + 1] += 1e-12
    heights = scale * np.linalg.solve(scaled, scale * (N.T @ y))
    misfit = (N @ heights - y) ** 2
    field = replace(field, knots=knots, heights=heights.reshape(knots.shape))
    return _Trial(Fitted(field, A, float(misfit.sum()) + PRICE * knots.size), misfit)


def smoothness(knots: Knots) -> Array:
    """Information of second differences of neighbouring heights (first mixed ones of a bilinear patch are free)."""
    return _smoothness(*knots.shape)


@lru_cache(maxsize=256)
def _smoothness(ns: int, nt: int) -> Array:
    out = np.zeros((ns * nt, ns * nt))
    for rows in (np.kron(_second(ns), np.eye(nt)), np.kron(np.eye(ns), _second(nt))):
        out += rows.T @ rows / SMOOTH**2
    out += 1e-6 / SMOOTH**2 * np.eye(len(out))
    out.flags.writeable = False
    return out


def _second(n: int) -> Array:
    return np.diff(np.eye(n), 2, axis=0) if n > 2 else np.zeros((1, n))


def _improve(best: _Trial, data: _Data) -> HeightField | None:
    """The best next step, or where none pays the best pair of steps; None where no pair pays, either."""
    singles = [_solve(best.fitted.field, knots, data) for knots in _moves(best, data)]
    first = min((one.fitted for one in singles), key=lambda f: f.criterion, default=best.fitted)
    if first.criterion < best.fitted.criterion:
        return first.field
    tried: set[bytes] = set()
    second = best.fitted
    for one in singles:
        for knots in _moves(one, data):
            key = bytes((knots.degree_s, knots.degree_t)) + knots.s.tobytes() + knots.t.tobytes()
            if key not in tried:
                tried.add(key)
                second = min(second, _solve(one.fitted.field, knots, data).fitted, key=lambda f: f.criterion)
    return second.field if second is not best.fitted else None


def _moves(trial: _Trial, data: _Data) -> Iterator[Knots]:
    """Knots with a higher degree along s or t, or with the span of most excess halved."""
    k = trial.fitted.field.knots
    if k.size > MOST:
        return
    uv = np.clip(data.feet.uv, 0.0, 1.0)
    # Only where the data stand at more places than there will be control points along this direction.
    if data.places[0] > k.shape[0] + 1:
        if k.degree_s < HIGHEST_DEGREE:
            yield k._replace(degree_s=k.degree_s + 1, s=with_degree(k.s, k.degree_s))
        place = _worst_span(k.s, uv[:, 0], trial.misfit)
        if place is not None:
            yield k._replace(s=with_knot(k.s, k.degree_s, place))
    if data.places[1] > k.shape[1] + 1:
        if k.degree_t < HIGHEST_DEGREE:
            yield k._replace(degree_t=k.degree_t + 1, t=with_degree(k.t, k.degree_t))
        place = _worst_span(k.t, uv[:, 1], trial.misfit)
        if place is not None:
            yield k._replace(t=with_knot(k.t, k.degree_t, place))


def _worst_span(knots: Array, u: Array, misfit: Array) -> float | None:
    """Middle of the span with most chi square over its share, if both halves have data."""
    breaks = np.unique(knots)
    span = np.clip(np.searchsorted(breaks, u, side="right") - 1, 0, len(breaks) - 2)
    total = np.bincount(span, misfit - 1.0, len(breaks) - 1)
    worst = int(np.argmax(total))
    middle = (breaks[worst] + breaks[worst + 1]) / 2.0
    inside = u[span == worst]
    if _places(inside) < 4 or not (inside < middle).any() or not (inside > middle).any():
        return None
    return float(middle)
