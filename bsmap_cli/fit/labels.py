"""Which face each beam belongs to: outliers dropped, beams of the rest adopted, borders moved to the creases."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.feet import STEEPEST, Feet, Met, Table, find_feet, meet, tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.model import Array, IntArray

OUTLIER, ADOPTED = 4.5, 3.5
"""Standard deviations beyond which a beam leaves its face, within which one of the rest joins a neighbouring face."""
NEXT = ((-1, 0), (1, 0), (0, -2), (0, -1), (0, 1), (0, 2))
"""Scans and beams from a beam to those that its face may adopt."""
PASSES = 30
TOUCHING = 1.0
"""Standard deviations within which two surfaces touch."""
GAP = 3
"""Beams of the rest that may lie at a border."""
SHORT = 3
"""Beams of a run that may be other faces' beams gone astray."""
REACH = 12
"""Beams by which a border may move at once."""


class Runs(NamedTuple):
    """Stretches of beams of one face: row, first beam, beam behind the last one, face, (k,) each."""

    row: IntArray
    start: IntArray
    stop: IntArray
    label: IntArray


def runs_of(labels: IntArray) -> Runs:
    """Runs of equal labels, scan after scan, without the rest."""
    m, n = labels.shape
    change = np.ones((m, n), dtype=bool)
    change[:, 1:] = labels[:, 1:] != labels[:, :-1]
    first = np.flatnonzero(change)
    stop = np.append(first[1:], m * n)
    label = labels.ravel()[first]
    row, start = first // n, first % n
    keep = label >= 0
    return Runs(row[keep], start[keep], (stop - row * n)[keep], label[keep])


def met_at(
    grid: BeamGrid, table: Table, face: IntArray, row: IntArray, column: IntArray, start: Array | None = None
) -> Met:
    """Where beams (k,) meet the faces (k,) of a table; start: metres (k,) beyond their ends where to look first."""
    points, directions = grid.points.reshape(-1, 3), grid.directions.reshape(-1, 3)
    return meet(table, face, points, directions, row * grid.hit.shape[1] + column, start)


def places_of_faces(grid: BeamGrid, labels: IntArray, faces: int) -> list[IntArray]:
    """Flat indices of the beams of each of so many faces that have a return, in the order of the grid."""
    at = by_face(np.flatnonzero((labels >= 0) & grid.hit), labels, faces)
    ends = np.cumsum(np.bincount(labels.ravel()[at], minlength=faces)).tolist()
    return [at[a:b] for a, b in itertools.pairwise([0, *ends])]


def by_face(at: IntArray, labels: IntArray, faces: int) -> IntArray:
    """Flat indices `at` (k,) of beams, face after face."""
    # Short numbers are sorted in one pass.
    kind = np.int16 if faces < 2**15 else np.int64
    return at[np.argsort(labels.ravel()[at].astype(kind), kind="stable")]


def feet_of_faces(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField]) -> list[Feet]:
    """Feet of the beams of each face that have a return, in the order of the grid."""
    places = places_of_faces(grid, labels, len(fields))
    at = np.concatenate([np.zeros(0, dtype=np.int64), *places])
    points, directions = (of.reshape(-1, 3)[at] for of in (grid.points, grid.directions))
    feet = find_feet(
        tabulate(fields), np.repeat(np.arange(len(fields)), [len(of) for of in places]), points, directions
    )
    ends = np.cumsum([0, *(len(of) for of in places)]).tolist()
    return [Feet(*(of[a:b] for of in feet)) for a, b in itertools.pairwise(ends)]


def adopt(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Give beams of the rest to a neighbouring face that predicts them, until none is left that can have one."""
    labels, table = labels.copy(), tabulate(fields)
    tried = np.zeros((len(fields), *labels.shape), dtype=bool)
    for _ in range(PASSES):
        free = (labels < 0) & grid.hit
        face, row, column = _candidates(labels, free, tried)
        tried[face, row, column] = True
        met = met_at(grid, table, face, row, column)
        miss = np.where(np.abs(met.slope) > STEEPEST, np.abs(met.beyond), np.inf)
        order = np.lexsort((face, miss))
        order = order[miss[order] < ADOPTED * sigma][::-1]
        if not len(order):
            break
        # The last one written is the best.
        labels[row[order], column[order]] = face[order]
    return fill(grid, labels)


def _candidates(
    labels: IntArray, free: NDArray[np.bool_], tried: NDArray[np.bool_]
) -> tuple[IntArray, IntArray, IntArray]:
    """Face, row and column (k,) of free beams beside a face that has not tried them."""
    m, n = labels.shape
    row, column = np.nonzero(free)
    faces = [np.zeros(0, dtype=np.int64)]
    at = [np.zeros(0, dtype=np.int64)]
    for up, step in NEXT:
        r, c = row + up, column + step
        inside = np.flatnonzero((r >= 0) & (r < m) & (c >= 0) & (c < n))
        face = labels[r[inside], c[inside]]
        faces.append(face[face >= 0])
        at.append(inside[face >= 0])
    number, beam = np.concatenate(faces), np.concatenate(at)
    pairs = np.unique(number * len(row) + beam) if len(row) else number
    face, beam = pairs // max(1, len(row)), pairs % max(1, len(row))
    new = ~tried[face, row[beam], column[beam]]
    return face[new], row[beam[new]], column[beam[new]]


def fill(grid: BeamGrid, labels: IntArray, widest: int = 3) -> IntArray:
    """Give beams without return, up to `widest` in a row between beams of one face, that face's number."""
    labels = np.where(grid.hit, labels, -1)
    for width in range(1, widest + 1):
        left, right = labels[:, : -width - 1], labels[:, width + 1 :]
        same = (left == right) & (left >= 0)
        for k in range(1, width + 1):
            same &= ~grid.hit[:, k : k + left.shape[1]]
        for k in range(1, width + 1):
            part = labels[:, k : k + left.shape[1]]
            part[same] = left[same]
    return labels


def enclosed(grid: BeamGrid, labels: IntArray, widest: int = 12) -> IntArray:
    """As `fill`, more in a row where the scans before and behind show the face at each of them.

    Dark places return few beams: what is lost between so many neighbours is no hole.
    """
    lost = ~grid.hit & (labels < 0)
    edge = np.diff(np.pad(lost, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    (row, start), (_, stop) = np.nonzero(edge > 0), np.nonzero(edge < 0)
    inner = (start > 0) & (stop < labels.shape[1]) & (stop - start <= widest) & (row > 0) & (row < len(labels) - 1)
    row, start, stop = row[inner], start[inner], stop[inner]
    face = np.where(labels[row, start - 1] == labels[row, stop], labels[row, start - 1], -1)
    run = np.repeat(np.arange(len(row)), stop - start)
    column = np.arange(len(run)) - np.repeat(np.cumsum(stop - start) - stop, stop - start)
    around = (labels[row[run] - 1, column] == face[run]) & (labels[row[run] + 1, column] == face[run])
    whole = (np.bincount(run[~around], minlength=len(row)) == 0) & (face >= 0)
    out = labels.copy()
    out[row[run], column] = np.where(whole[run], face[run], labels[row[run], column])
    return out


class _Borders(NamedTuple):
    """Between two faces of one scan, (k,) each: row, last beam of face a, first beam of face b.

    second : whether it is the second, fourth ... of successive borders of a scan: it shares a face with the one before.
    """

    row: IntArray
    last: IntArray
    first: IntArray
    a: IntArray
    b: IntArray
    second: NDArray[np.bool_]


def _borders(labels: IntArray) -> _Borders:
    row, start, stop, label = runs_of(labels)
    near = (row[1:] == row[:-1]) & (start[1:] - stop[:-1] <= GAP) & (label[1:] != label[:-1])
    k = np.flatnonzero(near)
    return _Borders(row[k], stop[k] - 1, start[k + 1], label[k], label[k + 1], k % 2 == 1)


def _untangled(grid: BeamGrid, labels: IntArray, table: Table, sigma: float) -> IntArray:
    """Labels without the runs of a few beams between two of one other face that explains them as well.

    Beside a crease, beams that were left out may have come back to the wrong face; there is one border then, not three.
    """
    labels = labels.copy()
    # First those between long ones of their surroundings, then those that were these surroundings.
    for shortest in range(1, SHORT + 1):
        row, start, stop, label = runs_of(labels)
        near = (row[1:] == row[:-1]) & (start[1:] - stop[:-1] <= GAP)
        k = 1 + np.flatnonzero(near[:-1] & near[1:] & (label[2:] == label[:-2]) & (label[1:-1] != label[:-2]))
        k = k[stop[k] - start[k] == shortest]
        other = label[k - 1]
        at = start[k, None] + np.arange(shortest)
        hit = grid.hit[row[k, None], at]
        of, i = np.nonzero(hit)
        met = met_at(grid, table, other[of], row[k[of]], at[of, i])
        good = np.ones(len(k), dtype=bool)
        good[of[np.abs(met.beyond) > OUTLIER * sigma]] = False
        labels[row[k[good], None], at[good]] = other[good, None]
    return labels


def move_breaks(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Move borders to where the two surfaces give the same range; where they do not meet, to where they fit best."""
    table = tabulate(fields)
    labels = _untangled(grid, labels, table, sigma)
    borders = _borders(labels)
    # Successive borders may want the same beams: every second one moves first.
    for second in (False, True):
        _move(grid, labels, table, _Borders(*(of[borders.second == second] for of in borders)), sigma)
    return np.where(grid.hit, labels, -1) if not len(borders.row) else fill(grid, labels)


def _move(grid: BeamGrid, labels: IntArray, table: Table, borders: _Borders, sigma: float) -> None:
    """Write into the labels where borders go that have no beams in common."""
    row, last, first, a, b, _ = borders
    n = labels.shape[1]
    at = last[:, None] + np.arange(-REACH, REACH + 5)
    column = np.clip(at, 0, n - 1)
    inside = (at >= 0) & (at < n) & (at <= (first + REACH)[:, None])
    found = labels[row[:, None], column]
    # On each side as far as the beams are the face's own, or between the two.
    left = np.where(at < last[:, None], inside & (found == a[:, None]), True)
    left = np.logical_and.accumulate(left[:, ::-1], axis=1)[:, ::-1]
    right = np.where(at > first[:, None], inside & (found == b[:, None]), True)
    right = np.logical_and.accumulate(right, axis=1)
    window = left & right
    to_a, to_b = np.full((2, *window.shape), np.nan)
    k, i = np.nonzero(window & grid.hit[row[:, None], column])
    for way, face in ((to_a, a), (to_b, b)):
        way[k, i] = met_at(grid, table, face[k], row[k], column[k, i]).beyond
    place = _best_breaks(to_a, to_b, np.full(len(row), REACH + 1), sigma)
    before = np.arange(at.shape[1]) < place[:, None]
    miss = np.where(before, to_a, to_b)
    new = np.where(np.abs(miss) > OUTLIER * sigma, -1, np.where(before, a[:, None], b[:, None]))
    k, i = np.nonzero(window)
    labels[row[k], column[k, i]] = new[k, i]


def _best_breaks(a: Array, b: Array, now: IntArray, sigma: float) -> IntArray:
    """Place (k,) of the first beam of the second face, of beams with distances a and b (k, w) to the two faces.

    Where the surfaces cross near the border: the crossing; where they touch, the nearest place. Else where the squared
    distances are least in sum. nan for
    beams without; where fewer than two are left, the place is `now` (k,).
    """
    count = np.count_nonzero(np.isfinite(a), axis=1)
    order = np.argsort(~np.isfinite(a), axis=1, kind="stable")
    a, b = (np.take_along_axis(x, order, axis=1) for x in (a, b))
    known = np.arange(a.shape[1]) < count[:, None]
    limit = 6.0 * sigma
    ea, eb = (np.where(known, np.minimum(np.abs(x), limit) ** 2, 0.0) for x in (a, b))
    total = np.cumsum(ea, axis=1) - np.cumsum(eb, axis=1)
    total = np.column_stack([np.zeros(len(a)), total]) + eb.sum(axis=1, keepdims=True)
    # As many beams as are known may come before the border, or fewer.
    total[:, 1:] = np.where(known, total[:, 1:], np.inf)
    least = total.min(axis=1, keepdims=True)
    crossing = np.zeros(total.shape, dtype=bool)
    crossing[:, 1:-1] = (np.sign(a - b)[:, 1:] != np.sign(a - b)[:, :-1]) & known[:, 1:]
    # Surfaces that only touch go on in each other: where the noise would have the border tells nothing.
    gap = np.where(known, np.abs(a - b), np.inf)
    nearest = gap.argmin(axis=1)
    touching = np.flatnonzero((gap.min(axis=1) < TOUCHING * sigma) & ~crossing.any(axis=1) & (nearest > 0))
    crossing[touching, nearest[touching]] = True
    # A crossing is believed where it explains the beams nearly as well as the best break.
    good = crossing & (total < least + 25.0 * sigma**2)
    best = np.where(good.any(axis=1), np.argmin(np.where(good, total, np.inf), axis=1), np.argmin(total, axis=1))
    places = np.column_stack([order, order[:, -1] + 1])
    behind = np.take_along_axis(order, np.maximum(count - 1, 0)[:, None], axis=1)[:, 0] + 1
    found = np.where(best < count, np.take_along_axis(places, best[:, None], axis=1)[:, 0], behind)
    return np.asarray(np.where(count < 2, now, found))
