"""Pieces of scan lines: stretches of beams that hit one straight or gently curved line.

In w = 1/range over the beam's angle a straight line is linear in {cos, sin}; adding 1 makes a conic with its focus in
the sensor, which follows gentle curves. With prefix sums of the moments the best line or conic of any interval of beams
costs the same small work. Breaks are found by dynamic programming over candidates, then moved to their best place.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.model import Array, IntArray

LINE_COST, CONIC_COST = 25.0, 37.0
"""Price of a piece in units of chi square: its parameters and its place among some hundred beams."""
JUNK_COST, JUNK_BEAM = 15.0, 8.0
"""Price of a stretch of beams that belongs to no line, and of each of its beams."""
FEWEST, FEWEST_CONIC = 4, 12
"""Beams of a line and of a conic."""
WINDOWS = (5, 10, 20, 40)
CANDIDATE = 12.0
"""Gain in chi square of two lines over one that makes a place a candidate for a break."""
FARTHEST = 10
"""Beams by which a break is moved."""
WIDEST_TURN = np.radians(60.0)
"""By which a conic may turn; what is longer is divided.

From there on pieces are taken for parabolas over their chords, which an arc of 60 degrees leaves by a 2500th of its
radius.
"""
WIDEST_GAP = 3
"""Beams without return that a piece may bridge."""


class Pieces(NamedTuple):
    """Stretches of beams: row (k,), first beam (k,), beam behind the last one (k,), whether curved (k,)."""

    row: IntArray
    start: IntArray
    stop: IntArray
    curved: NDArray[np.bool_]


def find_pieces(grid: BeamGrid) -> Pieces:
    """Pieces of all scan lines, scan after scan; what fits no line is in none."""
    moments = _prefix_moments(grid)
    gain = _break_gain(moments)
    found = []
    for row in range(len(grid.ranges)):
        places = [_candidates(grid, gain[:, row], row, *ends) for ends in _stretches(grid.hit[row])]
        found += [(row, *piece) for piece in _divide(moments[:, row], places)]
    if not found:
        none = np.zeros(0, dtype=np.int64)
        return Pieces(none, none, none, np.zeros(0, dtype=bool))
    table = np.array(found, dtype=np.int64)
    pieces = Pieces(table[:, 0], table[:, 1], table[:, 2], table[:, 3].astype(bool))
    for _ in range(2):
        pieces = _relocate(grid, moments, pieces)
    return _shortened(grid, pieces)


def _prefix_moments(grid: BeamGrid) -> Array:
    """(11, m, n + 1) sums over beams before each: W {cc, cs, ss, c, s, 1}, W w {c, s, 1}, W w^2, number of returns."""
    m, n = grid.ranges.shape
    r = np.where(grid.hit, grid.ranges, 1.0)
    W = np.where(grid.hit, r**4 / grid.sigma**2, 0.0)
    w, c, s = 1.0 / r, np.cos(grid.angles), np.sin(grid.angles)
    terms = (W * c * c, W * c * s, W * s * s, W * c, W * s, W, W * w * c, W * w * s, W * w, W * w * w, grid.hit * 1.0)
    out = np.zeros((11, m, n + 1))
    for term, sums in zip(terms, out, strict=True):
        np.cumsum(term, axis=1, out=sums[:, 1:])
    return out


OF_LINES = [0, 1, 2, 6, 7, 9, 10]
"""Moments that lines need."""


def _chi_line(d: Array) -> Array:
    """Chi square (...) of the best line by moments (11, ...)."""
    return _chi_line_of(*d[OF_LINES])


def _chi_line_of(cc: Array, cs: Array, ss: Array, wc: Array, ws: Array, ww: Array, number: Array) -> Array:
    """The same by those moments that lines need."""
    determinant = cc * ss - cs * cs
    good = (number >= 2) & (determinant > 0.0)
    explained = (ss * wc * wc - 2.0 * cs * wc * ws + cc * ws * ws) / np.where(good, determinant, 1.0)
    return np.where(good, np.maximum(ww - explained, 0.0), 0.0)


def _normal(d: Array, size: int) -> tuple[Array, Array]:
    """Normal matrices (k, size, size) and right sides (k, size) of lines (2) and conics (3) by moments (11, k)."""
    A = d[[[0, 1, 3], [1, 2, 4], [3, 4, 5]]][:size, :size]
    return A.transpose(2, 0, 1), d[6 : 6 + size].T


def _chi_conic(d: Array) -> Array:
    A, b = _normal(d, 3)
    x = np.linalg.solve(A + 1e-12 * np.trace(A, axis1=-2, axis2=-1)[..., None, None] * np.eye(3), b[..., None])[..., 0]
    return np.asarray(np.maximum(d[9] - np.sum(b * x, axis=-1), 0.0))


def _break_gain(moments: Array) -> Array:
    """(windows, m, n + 1) gain in chi square of a break before each beam, at several half windows."""
    _, m, places = moments.shape
    out = np.empty((len(WINDOWS), m, places))
    at = np.arange(places)
    of_lines = moments[OF_LINES]
    for row in range(m):
        here = of_lines[:, row]
        for k, half in enumerate(WINDOWS):
            low, high = np.maximum(at - half, 0), np.minimum(at + half, places - 1)
            before, behind = here[:, low], here[:, high]
            parts = np.stack([behind - before, here - before, behind - here], axis=1)
            both, left, right = _chi_line_of(*parts)
            enough = (parts[6, 1] >= 3) & (parts[6, 2] >= 3)
            out[k, row] = np.where(enough, both - left - right, 0.0)
    return out


def _stretches(hit: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Ranges (first, stop) of beams between gaps too wide to bridge."""
    at = np.flatnonzero(hit)
    if len(at) == 0:
        return []
    wide = np.flatnonzero(np.diff(at) > WIDEST_GAP + 1)
    first, last = np.concatenate([[0], wide + 1]), np.concatenate([wide, [len(at) - 1]])
    return [(int(at[a]), int(at[b]) + 1) for a, b in zip(first, last, strict=True)]


def _candidates(grid: BeamGrid, gain: Array, row: int, first: int, stop: int) -> IntArray:
    """Places of possible breaks in a stretch, both ends among them: peaks of the gain, jumps of range."""
    places = [np.array([first, stop])]
    for half, g in zip(WINDOWS, gain[:, first : stop + 1], strict=True):
        reach = max(2, half // 4)
        high = np.flatnonzero(g > CANDIDATE)
        around = np.clip(high[:, None] + np.arange(-reach, reach + 1), 0, len(g) - 1)
        places.append(first + high[g[high] >= g[around].max(axis=1)])
    step = np.abs(np.diff(grid.ranges[row, first:stop]))
    known = step[np.isfinite(step)]
    usual = np.median(known) if len(known) else 0.0
    places.append(first + 1 + np.flatnonzero(step > 8.0 * grid.sigma + 3.0 * usual))
    return np.unique(np.concatenate(places))


def _divide(moments: Array, stretches: list[IntArray]) -> Iterator[tuple[int, int, bool]]:
    """Cheapest division of stretches between their first and last places into lines, conics and junk.

    moments : (11, n + 1) of the beams before each place of the scan.  stretches : places of possible breaks of each.
    """
    pairs = [np.triu_indices(len(places), 1) for places in stretches]
    bounds = [(places[i], places[j]) for places, (i, j) in zip(stretches, pairs, strict=True)]
    if not bounds:
        return
    low, high = (np.concatenate(of) for of in zip(*bounds, strict=True))
    cost, kind = _prices(moments[:, high] - moments[:, low])
    ends = np.cumsum([len(i) for i, _ in pairs])[:-1]
    for places, (i, j), c, k in zip(stretches, pairs, np.split(cost, ends), np.split(kind, ends), strict=True):
        costs, kinds = np.full((len(places), len(places)), np.inf), np.zeros((len(places), len(places)), dtype=int)
        costs[j, i], kinds[j, i] = c, k
        yield from _cheapest(places.tolist(), costs, kinds)


def _prices(d: Array) -> tuple[Array, IntArray]:
    """Least price (k,) of intervals with moments (11, k), and as what: line, conic or junk."""
    count = d[10]
    line = np.where(count >= FEWEST, _chi_line(d) + LINE_COST, np.inf)
    conic = np.full(len(count), np.inf)
    # A conic is worth a look only where it could be cheaper than the line.
    look = (count >= FEWEST_CONIC) & (line - LINE_COST > CONIC_COST - LINE_COST)
    if look.any():
        conic[look] = _chi_conic(d[:, look]) + CONIC_COST
    prices = np.stack([line, conic, JUNK_COST + JUNK_BEAM * count])
    return prices.min(axis=0), np.argmin(prices, axis=0)


def _cheapest(places: list[int], costs: Array, kinds: IntArray) -> list[tuple[int, int, bool]]:
    """Pieces of the cheapest way from the first of k places to the last; costs (k, k) to a place from those before."""
    best, before = np.zeros(len(places)), [0] * len(places)
    for k in range(1, len(places)):
        total = best[:k] + costs[k, :k]
        before[k] = int(total.argmin())
        best[k] = total[before[k]]
    out, k = [], len(places) - 1
    while k > 0:
        b = before[k]
        if kinds[k, b] < 2:
            out.append((places[b], places[k], bool(kinds[k, b] == 1)))
        k = b
    return out[::-1]


def _relocate(grid: BeamGrid, moments: Array, pieces: Pieces) -> Pieces:
    """Move the breaks between touching pieces to where the two models together fit best."""
    d = moments[:, pieces.row, pieces.stop] - moments[:, pieces.row, pieces.start]
    models = np.zeros((len(pieces.row), 3))
    A, b = _normal(d, 2)
    models[:, :2] = np.linalg.solve(A, b[..., None])[..., 0]
    if pieces.curved.any():
        A, b = _normal(d[:, pieces.curved], 3)
        models[pieces.curved] = np.linalg.solve(A, b[..., None])[..., 0]
    start, stop = pieces.start.copy(), pieces.stop.copy()
    touching = np.flatnonzero((pieces.row[1:] == pieces.row[:-1]) & (pieces.start[1:] == pieces.stop[:-1]))
    # Successive breaks share a piece: every second one moves first.
    for turn in (0, 1):
        k = touching[touching % 2 == turn]
        low = np.maximum(start[k] + FEWEST, stop[k] - FARTHEST)
        high = np.minimum(stop[k + 1] - FEWEST, stop[k] + FARTHEST)
        k, low, high = (of[high > low] for of in (k, low, high))
        place = _best_places(grid, pieces.row[k], low, high, models[k], models[k + 1])
        stop[k] = start[k + 1] = place
    return Pieces(pieces.row, start, stop, pieces.curved)


def _best_places(grid: BeamGrid, row: IntArray, low: IntArray, high: IntArray, a: Array, b: Array) -> IntArray:
    """Places (k,) from `low` to `high` (k,) before which models a, behind which models b (k, 3) fit best in sum."""
    at = low[:, None] + np.arange(2 * FARTHEST)
    inside = at < high[:, None]
    at = np.minimum(at, len(grid.angles) - 1)
    ranges, angles = grid.ranges[row[:, None], at], grid.angles[at]
    c, s = np.cos(angles), np.sin(angles)
    squares = []
    for model in (a, b):
        inverse = model[:, :1] * c + model[:, 1:2] * s + model[:, 2:]
        with np.errstate(divide="ignore", invalid="ignore"):
            miss = np.minimum(np.abs(ranges - 1.0 / inverse), 10.0 * grid.sigma) ** 2
        squares.append(np.where(inside & np.isfinite(miss), miss, 0.0))
    total = np.zeros((len(row), at.shape[1] + 1))
    total[:, 1:] = np.cumsum(squares[0] - squares[1], axis=1)
    total[:, 1:][~inside] = np.inf
    return np.asarray(low + np.argmin(total, axis=1))


def _shortened(grid: BeamGrid, pieces: Pieces) -> Pieces:
    """Pieces with the conics that turn too far divided into equal parts."""
    parts = np.ones(len(pieces.row), dtype=np.int64)
    for k in np.flatnonzero(pieces.curved):
        beams = np.arange(pieces.start[k], pieces.stop[k])
        beams = beams[grid.hit[pieces.row[k], beams]]
        ends = beams[np.rint(np.linspace(0, len(beams) - 1, 4)).astype(np.int64)]
        places = grid.ranges[pieces.row[k], ends] * np.exp(1j * grid.angles[ends])
        first, _, last = np.diff(places)
        noise = 3.0 * grid.sigma * (1.0 / abs(first) + 1.0 / abs(last))
        # Chords of the first and the last third lie two thirds of the turn apart.
        turn = 1.5 * (abs(np.angle(last / first)) - noise)
        parts[k] = np.clip(np.ceil(turn / WIDEST_TURN), 1, len(beams) // FEWEST_CONIC)
    of = np.repeat(np.arange(len(parts)), parts)
    order = np.arange(len(of)) - (np.cumsum(parts) - parts)[of]
    length = pieces.stop - pieces.start
    start, stop = (pieces.start[of] + length[of] * (order + k) // parts[of] for k in (0, 1))
    return Pieces(pieces.row[of], start, stop, pieces.curved[of])
