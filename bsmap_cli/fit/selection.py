"""Which degrees and knots a height field gets: as many as the data pay for."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import clamped_knots, inner_knots
from bsmap_cli.core.gaussian import noncentrality
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.equations import Equations, linearise, misfits, normal_equations, number_of_places
from bsmap_cli.fit.heights import (
    Base,
    HeightField,
    Knots,
    least_knots,
    with_degree,
    with_knot,
)
from bsmap_cli.fit.smoothness import smoothness
from bsmap_cli.model import Array

PRICE = 5.0
"""Of a control point, in chi square: between Akaike's 2, which keeps the covariance honest, and the logarithm of the
number of data (BIC), which leaves gentle arcs flat."""
HIGHEST_DEGREE = 3
LEAST_BLOCKS = 4.0
"""Of each control point: what needs more than that is not smooth."""
MOST_STEPS = 40
"""Of one search."""
ANEW = 3
"""Times that knots are sought, each time about the surface found before."""
NEAR = 0.1
"""Standard deviations of a beam by which heights may change before the equations are made anew."""
SETTLED = 1e-5
"""Metres of change of the heights below which a fit about its own result is not repeated."""
MOST = 400
"""Control points of one face."""


class Fitted(NamedTuple):
    """A height field with the information (k, k) of its heights, and its criterion."""

    field: HeightField
    information: Array
    criterion: float


class _Solution(NamedTuple):
    """Heights (k,) on knots with their information (k, k) and that of the data alone, chi square and criterion."""

    knots: Knots
    heights: Array
    information: Array
    of_data: Array
    chi_square: float

    @property
    def freedom(self) -> float:
        """Number of heights that the data tell."""
        return float(np.trace(np.linalg.solve(self.information, self.of_data)))

    @property
    def criterion(self) -> float:
        return self.chi_square + PRICE * self.knots.size

    def on(self, field: HeightField) -> HeightField:
        """The field with these knots and heights."""
        return replace(field, knots=self.knots, heights=self.heights.reshape(self.knots.shape))

    def fitted(self, field: HeightField, told: float = 1.0) -> Fitted:
        """The field with these heights, and what is known of them, of which a share is told."""
        return Fitted(self.on(field), told * self.information, self.criterion)


def fit_heights(blocks: Blocks, base: Base, low: Array, high: Array, sigma: float) -> Fitted:
    """Fit with the degrees and knots of the best criterion, found step by step from the least surface.

    Its information is that of noise alone: for what the knots leave out, it is to be fitted again on its own knots.
    """
    knots = least_knots(base, low, high)
    field = HeightField(base, low, high, knots, np.zeros(knots.shape))
    data = linearise(field, blocks, sigma)
    best = _climb(_solve(knots, data), data, (_single_steps,))
    if _is_near(best, field, sigma):
        # Single steps have been tried about this very surface.
        best = _climb(best, data, (_double_steps, _fewer_steps))
    if _is_near(best, field, sigma):
        return best.fitted(field)
    field = best.on(field)
    data = linearise(field, blocks, sigma, data)
    best = _climb(_solve(best.knots, data), data, (_single_steps, _double_steps, _fewer_steps))
    if not _is_near(best, field, sigma):
        best = _settled(best.on(field), blocks, sigma, data).best
    return best.fitted(field)


def _is_near(best: _Solution, field: HeightField, sigma: float) -> bool:
    """Whether a solution is the field about which it was found, or so near it that its feet are the same."""
    return best.knots is field.knots and bool(np.abs(best.heights - field.heights.ravel()).max() < NEAR * sigma)


def refit(field: HeightField, blocks: Blocks, sigma: float, choose: bool = False) -> Fitted:
    """Fit on the degrees and knots that a field has; choose: on those that now pay, unless it is the least surface."""
    now = _settled(field, blocks, sigma, None)
    beyond = _beyond(now.best, now.data)
    for _ in range(ANEW if choose and field.knots.size > now.data.least.size else 0):
        # What no data bear any more goes first: it would stand in the way of other steps.
        fewer = _climb(now.best, now.data, (_fewer_steps,))
        if fewer is now.best and not beyond.pays:
            break
        chosen = _chosen(fewer, field, blocks, sigma, now.data)
        if chosen.best.knots is now.best.knots:
            break
        now, beyond = chosen, _beyond(chosen.best, chosen.data)
    return now.best.fitted(field, _told(now.best, beyond))


class _Settled(NamedTuple):
    """A solution about its own surface, nearly, the equations for it, and metres of its last change."""

    best: _Solution
    data: Equations
    change: float


def _chosen(fewer: _Solution, field: HeightField, blocks: Blocks, sigma: float, data: Equations) -> _Settled:
    """What is found on the knots that pay from those of a solution on."""
    best = _climb(fewer, data, (_single_steps, _double_steps, _fewer_steps))
    found = _settled(best.on(field), blocks, sigma, data)
    if found.change < sigma or best is fewer:
        return found
    # More knots about a surface that is far from the data may follow equations that hold nowhere.
    found = _settled(found.best.on(field), blocks, sigma, None)
    other = _settled(fewer.on(field), blocks, sigma, data)
    return other if found.change >= sigma or other.best.criterion <= found.best.criterion else found


def _settled(field: HeightField, blocks: Blocks, sigma: float, data: Equations | None) -> _Settled:
    """Fit on a field's knots, repeated about its own result; data: equations about one near it."""
    for _ in range(2):
        about = data = linearise(field, blocks, sigma, data)
        best = _solve(field.knots, about)
        change = float(np.abs(best.heights - field.heights.ravel()).max())
        field = best.on(field)
        if change < SETTLED:
            break
    return _Settled(best, about, change)


class _Beyond(NamedTuple):
    """What finer knots along s, and along t, would gain in chi square, and how many heights more they have, in all.

    pays : whether a knot or a degree more may pay.
    """

    gain: float
    more: float
    pays: bool


def _beyond(best: _Solution, data: Equations) -> _Beyond:
    """All spans halved and a degree more along s, and along t; nothing of the least surface, which is not refined.

    Halving alone is blind to what is even, or odd, about the middle of a span.
    """
    gains, more = [0.0, 0.0], 0.0
    if best.knots.size > data.least.size:
        for axis in (0, 1):
            finer = _solve(_finer(best.knots, axis), data)
            # Shorter spans are held smooth more tightly: where no data bear them, that may cost more than they gain.
            gains[axis] = max(0.0, best.chi_square - finer.chi_square)
            more += finer.freedom - best.freedom
    pays = any(gain > PRICE * across for gain, across in zip(gains, best.knots.shape[::-1], strict=True))
    return _Beyond(sum(gains), more, pays)


def _told(best: _Solution, beyond: _Beyond) -> float:
    """Share of the information on the heights that is told: 1 for the least surface, which the base stands for.

    What was chosen to follow the data errs by what was left out, too. How much that is, the data tell: by how much
    more than noise alone chi square would fall on finer knots.
    """
    if not beyond.more:
        return 1.0
    return best.knots.size / (best.knots.size + noncentrality(beyond.gain, beyond.more))


def _finer(knots: Knots, axis: int) -> Knots:
    """Knots with another one in the middle of each span along s or t, and a degree more there, up to the highest."""
    degree, along = _along(knots, axis)
    breaks, inner = np.unique(along), inner_knots(along, degree)
    degree = min(degree + 1, HIGHEST_DEGREE)
    return _with(knots, axis, _Line(degree, clamped_knots(degree, [*inner, *(breaks[1:] + breaks[:-1]) / 2.0])))


def _solve(knots: Knots, data: Equations) -> _Solution:
    """Least squares on given knots."""
    A, b = normal_equations(knots, data)
    information = A + smoothness(knots, data.size)
    scale = 1.0 / np.sqrt(information.diagonal())
    scaled = information * scale[:, None] * scale
    scaled.flat[:: len(A) + 1] += 1e-12
    heights = scale * np.linalg.solve(scaled, scale * b)
    chi_square = data.square - float(heights @ (2.0 * b - A @ heights))
    return _Solution(knots, heights, information, A, max(0.0, chi_square))


_Steps = Callable[[Knots, Equations, Array], Iterator[Knots]]


def _climb(best: _Solution, data: Equations, kinds: Sequence[_Steps]) -> _Solution:
    """The solution to which the best steps lead while they pay; those of later kinds only where no earlier one does."""
    for _ in range(MOST_STEPS):
        misfit = misfits(best.knots, best.heights, data) ** 2
        for steps in kinds:
            found = [_solve(knots, data) for knots in steps(best.knots, data, misfit)]
            first = min(found, key=lambda one: one.criterion, default=best)
            if first.criterion < best.criterion:
                best = first
                break
        else:
            break
    return best


def _single_steps(knots: Knots, data: Equations, misfit: Array) -> Iterator[Knots]:
    """Knots with a higher degree along s or t, or with the span of most excess halved."""
    for axis in (0, 1):
        old = _along(knots, axis)
        if _room(knots, data, axis, 1):
            for new in (_raised(old), _halved(old, data, axis, misfit)):
                if new is not None:
                    yield _with(knots, axis, new)


def _double_steps(knots: Knots, data: Equations, misfit: Array) -> Iterator[Knots]:
    """The same twice along s, or twice along t: across each other two steps that do not pay hardly ever do."""
    for axis in (0, 1):
        old = _along(knots, axis)
        if not _room(knots, data, axis, 2):
            continue
        raised, halved = _raised(old), _halved(old, data, axis, misfit)
        for one, both in ((raised, _raised), (halved, _raised)):
            if one is not None and (new := both(one)) is not None:
                yield _with(knots, axis, new)
        if halved is not None and (new := _halved(halved, data, axis, misfit)) is not None:
            yield _with(knots, axis, new)


def _fewer_steps(knots: Knots, data: Equations, misfit: Array) -> Iterator[Knots]:
    """Knots without one of the inner ones, or of a lower degree along s or t: what later steps have made needless."""
    for axis in (0, 1):
        old, least = _along(knots, axis), _along(data.least, axis)
        inner = inner_knots(old.knots, old.degree)
        for k in np.flatnonzero(~np.isin(inner, inner_knots(least.knots, least.degree))).tolist():
            yield _with(knots, axis, _Line(old.degree, clamped_knots(old.degree, np.delete(inner, k))))
        if old.degree > least.degree:
            yield _with(knots, axis, _Line(old.degree - 1, clamped_knots(old.degree - 1, inner)))


class _Line(NamedTuple):
    """Degree and knots along one direction."""

    degree: int
    knots: Array


def _along(knots: Knots, axis: int) -> _Line:
    return _Line(knots.degree_t, knots.t) if axis else _Line(knots.degree_s, knots.s)


def _with(knots: Knots, axis: int, line: _Line) -> Knots:
    """Knots with others along one direction."""
    if axis:
        return knots._replace(degree_t=line.degree, t=line.knots)
    return knots._replace(degree_s=line.degree, s=line.knots)


def _room(knots: Knots, data: Equations, axis: int, steps: int) -> bool:
    """Whether the data stand at more places than there will be control points along a direction, and are enough."""
    more = knots.size * (knots.shape[axis] + steps) / knots.shape[axis]
    return more <= min(MOST, len(data.root) / LEAST_BLOCKS) and data.places[axis] > knots.shape[axis] + steps


def _raised(line: _Line) -> _Line | None:
    """A degree more, up to the highest."""
    return _Line(line.degree + 1, with_degree(line.knots, line.degree)) if line.degree < HIGHEST_DEGREE else None


def _halved(line: _Line, data: Equations, axis: int, misfit: Array) -> _Line | None:
    """The span with most chi square (n,) over its share halved, if both halves have data."""
    u = np.clip(data.feet.uv[:, axis], 0.0, 1.0)
    if len(line.knots) == 2 * line.degree + 2:
        middle, inside, places = 0.5, u, data.places[axis]
    else:
        breaks = np.unique(line.knots)
        span = np.clip(np.searchsorted(breaks, u, side="right") - 1, 0, len(breaks) - 2)
        worst = int(np.argmax(np.bincount(span, misfit - 1.0, len(breaks) - 1)))
        middle = float(breaks[worst] + breaks[worst + 1]) / 2.0
        inside = u[span == worst]
        places = number_of_places(inside)
    if places < 4 or not (inside < middle).any() or not (inside > middle).any():
        return None
    return _Line(line.degree, with_knot(line.knots, line.degree, middle))
