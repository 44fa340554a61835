"""Pieces of scan lines: stretches of beams that hit one straight or gently curved line.

In w = 1/range over the beam's angle a straight line is linear in {cos, sin}; adding 1 makes a conic with its focus in
the sensor, which follows gentle curves. With prefix sums of the moments the best line or conic of any interval of beams
costs the same small work. Breaks are found by dynamic programming over candidates, then moved to their best place.
"""

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
ELEMENTS = 20_000
"""Places, or pairs of them, worked on at once: their moments fit into the cache."""


class Pieces(NamedTuple):
    """Stretches of beams: row (k,), first beam (k,), beam behind the last one (k,), whether curved (k,)."""

    row: IntArray
    start: IntArray
    stop: IntArray
    curved: NDArray[np.bool_]


def find_pieces(grid: BeamGrid) -> Pieces:
    """Pieces of all scan lines, scan after scan; what fits no line is in none."""
    moments = _prefix_moments(grid)
    stretches = _stretches(grid.hit)
    pieces = _divide(moments, stretches, _candidates(grid, _break_gain(moments), stretches))
    for _ in range(2):
        pieces = _relocate(grid, moments, pieces)
    return _shortened(grid, pieces)


def _prefix_moments(grid: BeamGrid) -> Array:
    """(11, m, n + 1) sums over beams before each: W {cc, cs, ss, c, s, 1}, W w {c, s, 1}, W w^2, number of returns."""
    m, n = grid.ranges.shape
    r = np.where(grid.hit, grid.ranges, 1.0)
    W = np.where(grid.hit, (r * r / grid.sigma) ** 2, 0.0)
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
    widest = 2 * max(WINDOWS)
    # Windows that reach beyond an end of the scan are cut there. So many scans at once fit into the cache.
    at = np.clip(np.arange(-widest, places + widest), 0, places - 1)
    step = max(1, ELEMENTS // len(at))
    for rows in (slice(first, first + step) for first in range(0, m, step)):
        here = moments[OF_LINES, rows][..., at]
        intervals = {}
        for length in sorted({*WINDOWS, *(2 * half for half in WINDOWS)}):
            d = here[..., length:] - here[..., :-length]
            intervals[length] = _chi_line_of(*d), d[6] >= 3
        for k, half in enumerate(WINDOWS):
            before, behind = slice(widest - half, widest - half + places), slice(widest, widest + places)
            (chi, enough), (both, _) = intervals[half], intervals[2 * half]
            gain = both[:, before] - chi[:, before] - chi[:, behind]
            out[k, rows] = np.where(enough[:, before] & enough[:, behind], gain, 0.0)
    return out


class _Stretches(NamedTuple):
    """Beams between gaps too wide to bridge: row (k,), first beam (k,), beam behind the last one (k,)."""

    row: IntArray
    first: IntArray
    stop: IntArray


def _stretches(hit: NDArray[np.bool_]) -> _Stretches:
    """Stretches of all scans, scan after scan."""
    row, column = np.nonzero(hit)
    begins = (np.diff(row, prepend=-1) != 0) | (np.diff(column, prepend=0) > WIDEST_GAP + 1)
    first = np.flatnonzero(begins)
    return _Stretches(row[first], column[first], column[np.append(first[1:], len(row)) - 1] + 1)


def _candidates(grid: BeamGrid, gain: Array, stretches: _Stretches) -> list[IntArray]:
    """Places of possible breaks in each stretch, both ends among them: peaks of the gain, jumps of range."""
    places = gain.shape[2]
    length = stretches.stop - stretches.first + 1
    of = np.repeat(np.arange(len(length)), length)
    column = np.arange(len(of)) - np.repeat(np.cumsum(length) - length - stretches.first, length)
    place = stretches.row[of] * places + column
    is_end = (column == stretches.first[of]) | (column == stretches.stop[of])
    chosen = is_end | _jumps(grid, stretches, of, column)
    start, last = np.cumsum(length) - length, np.cumsum(length) - 1
    for half, g in zip(WINDOWS, gain.reshape(len(gain), -1)[:, place], strict=True):
        reach = max(2, half // 4)
        high = np.flatnonzero(g > CANDIDATE)
        around = high + np.arange(-reach, reach + 1)[:, None]
        around = np.clip(around, start[of[high]], last[of[high]])
        chosen[high[g[high] >= g[around].max(axis=0)]] = True
    return np.split(column[chosen], np.cumsum(np.bincount(of[chosen], minlength=len(length)))[:-1])


def _jumps(grid: BeamGrid, stretches: _Stretches, of: IntArray, column: IntArray) -> NDArray[np.bool_]:
    """Which places (k,) of stretches `of` (k,) lie behind a step of range that is unusual there."""
    row = stretches.row[of]
    inner = (column > stretches.first[of]) & (column < stretches.stop[of])
    step = np.full(len(of), np.nan)
    step[inner] = np.abs(grid.ranges[row[inner], column[inner]] - grid.ranges[row[inner], column[inner] - 1])
    known = np.isfinite(step)
    # All medians by one sort: in front of the point the stretch, behind it the step.
    scale = 1.0 + step[known].max(initial=0.0)
    keys = np.sort(of[known] + step[known] / scale)
    count = np.bincount(of[known], minlength=len(stretches.row))
    start = np.cumsum(count) - count
    some = np.flatnonzero(count)
    usual = np.zeros(len(count))
    middle = start[some] + (count[some] - 1) // 2, start[some] + count[some] // 2
    usual[some] = ((keys[middle[0]] + keys[middle[1]]) / 2.0 - some) * scale
    return np.asarray(step > 8.0 * grid.sigma + 3.0 * usual[of])


def _divide(moments: Array, stretches: _Stretches, places: list[IntArray]) -> Pieces:
    """Cheapest division of stretches between their first and last places into lines, conics and junk.

    moments : (11, m, n + 1) of the beams before each place.  places : of possible breaks of each stretch.
    """
    found: dict[int, list[tuple[int, int, bool]]] = {}
    size = np.array([len(of) for of in places], dtype=np.int64)
    # Together those with alike many places, as many as fit into the cache.
    waiting = np.argsort(size, kind="stable")
    while len(waiting):
        count = max(1, int(np.searchsorted(np.arange(1, len(waiting) + 1) * size[waiting] ** 2, ELEMENTS)))
        chunk, waiting = waiting[:count], waiting[count:]
        made = _divide_alike(moments, stretches.row[chunk], [places[k] for k in chunk])
        for k, pieces in zip(chunk.tolist(), made, strict=True):
            found[k] = pieces
    rows = stretches.row.tolist()
    table = np.array([(rows[k], *piece) for k in range(len(rows)) for piece in found[k]], dtype=np.int64).reshape(-1, 4)
    return Pieces(table[:, 0], table[:, 1], table[:, 2], table[:, 3].astype(bool))


def _divide_alike(moments: Array, row: IntArray, places: list[IntArray]) -> list[list[tuple[int, int, bool]]]:
    """Pieces of each of the stretches in scans `row` (k,), all at once."""
    most = max(len(of) for of in places)
    at = np.zeros((len(places), most), dtype=np.int64)
    known = np.zeros(at.shape, dtype=bool)
    for k, of in enumerate(places):
        at[k, : len(of)], known[k, : len(of)] = of, True
    i, j = np.triu_indices(most, 1)
    stretch, pair = np.nonzero(known[:, j])
    low, high = at[stretch, i[pair]], at[stretch, j[pair]]
    cost, kind = _prices(moments[:, row[stretch], high] - moments[:, row[stretch], low])
    costs = np.full((len(places), most, most), np.inf)
    kinds = np.zeros(costs.shape, dtype=np.int64)
    costs[stretch, j[pair], i[pair]], kinds[stretch, j[pair], i[pair]] = cost, kind
    return [
        _way(of.tolist(), before.tolist(), kind)
        for of, before, kind in zip(places, _cheapest(costs), kinds, strict=True)
    ]


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


def _cheapest(costs: Array) -> IntArray:
    """(s, k) the place before each on the cheapest way from the first; costs (s, k, k) to places from those before."""
    best = np.zeros(costs.shape[:2])
    before = np.zeros(costs.shape[:2], dtype=np.int64)
    every = np.arange(len(costs))
    for k in range(1, costs.shape[1]):
        total = best[:, :k] + costs[:, k, :k]
        before[:, k] = total.argmin(axis=1)
        best[:, k] = total[every, before[:, k]]
    return before


def _way(places: list[int], before: list[int], kinds: IntArray) -> list[tuple[int, int, bool]]:
    """Pieces of the way back from the last of k places; kinds (k, k) of what leads to a place from one before."""
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
