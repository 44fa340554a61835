"""Which face each beam belongs to: outliers dropped, beams of the rest adopted, borders moved to the creases."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.heights import STEEPEST, Feet, HeightField, find_feet
from bsmap_cli.model import Array, IntArray

OUTLIER, ADOPTED = 4.5, 3.5
"""Standard deviations beyond which a beam leaves its face, within which one of the rest joins a neighbouring face."""
ALIKE = ((3, 3), (7, 1))
"""Scans and beams of neighbourhoods whose misses are added up."""
PASSES = 30
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


def feet_of(grid: BeamGrid, field: HeightField, mask: NDArray[np.bool_]) -> Feet:
    """Feet of the beams of a mask (m, n) on a height field."""
    return find_feet(field, grid.points[mask], grid.directions[mask])


def feet_of_faces(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField]) -> list[Feet]:
    """Feet of the beams of each face that have a return, in the order of the grid."""
    return [feet_of(grid, field, (labels == number) & grid.hit) for number, field in enumerate(fields)]


def drop_outliers(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Labels without the beams that miss their face by more than noise, or that graze it."""
    labels = labels.copy()
    for number, field in enumerate(fields):
        mask = (labels == number) & grid.hit
        feet = feet_of(grid, field, mask)
        labels[mask] = np.where(np.abs(feet.beyond) < OUTLIER * sigma, number, -1)
    return labels


def drop_alike(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Labels without the beams that miss their face by less than an outlier, but together with their neighbours.

    The side of a recess that is no deeper than the gate of outliers would otherwise be shared out to the faces above
    and below it.
    """
    labels = labels.copy()
    for number, field in enumerate(fields):
        mask = (labels == number) & grid.hit
        miss, count = np.zeros(labels.shape), mask.astype(float)
        miss[mask] = np.clip(feet_of(grid, field, mask).beyond / sigma, -OUTLIER, OUTLIER)
        for window in ALIKE:
            total, number_of = (ndimage.convolve(of, np.ones(window), mode="constant") for of in (miss, count))
            labels[mask & (np.abs(total) > OUTLIER * np.sqrt(number_of)) & (miss * total > 0.0)] = -1
    return labels


def adopt(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Give beams of the rest to a neighbouring face that predicts them, until none is left that can have one."""
    labels = labels.copy()
    tried = np.zeros((len(fields), *labels.shape), dtype=bool)
    for _ in range(PASSES):
        free = (labels < 0) & grid.hit
        best = np.full(labels.shape, np.inf)
        new = np.full(labels.shape, -1)
        for number, field in enumerate(fields):
            near = _grown(labels == number) & free & ~tried[number]
            if not near.any():
                continue
            tried[number] |= near
            feet = feet_of(grid, field, near)
            miss = np.where(np.abs(feet.slope) > STEEPEST, np.abs(feet.beyond), np.inf)
            better = np.zeros(labels.shape, dtype=bool)
            better[near] = (miss < ADOPTED * sigma) & (miss < best[near])
            best[better] = miss[better[near]]
            new[better] = number
        if np.all(new < 0):
            break
        labels = np.where(new >= 0, new, labels)
    return fill(grid, labels)


def _grown(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask with its neighbours, one away in scans and two in beams."""
    out = mask.copy()
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    for step in (1, 2):
        out[:, step:] |= mask[:, :-step]
        out[:, :-step] |= mask[:, step:]
    return out


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


class _Border(NamedTuple):
    """Between two faces of one scan: row, last beam of face a, first beam of face b."""

    row: int
    last: int
    first: int
    a: int
    b: int


def _borders(labels: IntArray) -> list[_Border]:
    runs = runs_of(labels)
    next_to = (runs.row[1:] == runs.row[:-1]) & (runs.start[1:] - runs.stop[:-1] <= 3)
    return [
        _Border(
            int(runs.row[k]), int(runs.stop[k]) - 1, int(runs.start[k + 1]), int(runs.label[k]), int(runs.label[k + 1])
        )
        for k in np.flatnonzero(next_to & (runs.label[1:] != runs.label[:-1]))
    ]


def move_breaks(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Move borders to where the two surfaces give the same range; where they do not meet, to where they fit best."""
    borders = _borders(labels)
    ranges = _ranges_around(grid, labels.shape, borders, fields)
    labels = labels.copy()
    for border in borders:
        low, high = _window(labels, border)
        span = slice(low, high)
        a, b = ranges[border.a][border.row, span], ranges[border.b][border.row, span]
        place = low + _best_break(a, b, border.last + 1 - low, sigma)
        row = labels[border.row]
        row[low:place], row[place:high] = border.a, border.b
        miss = np.concatenate([a[: place - low], b[place - low :]])
        row[span][np.abs(miss) > OUTLIER * sigma] = -1
    return np.where(grid.hit, labels, -1) if not len(borders) else fill(grid, labels)


def _window(labels: IntArray, border: _Border) -> tuple[int, int]:
    """Beams around a border that belong to its two faces, or to none in between."""
    row = labels[border.row]
    low, high = border.last, border.first + 1
    while low > 0 and border.last - low < REACH and row[low - 1] == border.a:
        low -= 1
    while high < len(row) and high - border.first <= REACH and row[high] == border.b:
        high += 1
    return low, high


def _ranges_around(
    grid: BeamGrid, shape: tuple[int, ...], borders: list[_Border], fields: Sequence[HeightField]
) -> list[Array]:
    """For each face (m, n) metres from the measured point to the face along the beam, around its borders; else nan."""
    wanted = np.zeros((len(fields), *shape), dtype=bool)
    for border in borders:
        span = slice(max(0, border.last - REACH), border.first + REACH + 1)
        wanted[border.a, border.row, span] = wanted[border.b, border.row, span] = True
    out = []
    for field, mask in zip(fields, wanted, strict=True):
        beyond = np.full(shape, np.nan)
        mask &= grid.hit
        if mask.any():
            beyond[mask] = feet_of(grid, field, mask).beyond
        out.append(beyond)
    return out


def _best_break(a: Array, b: Array, now: int, sigma: float) -> int:
    """Number of beams, of those with distances a and b (k,) to the two faces, that belong to the first.

    Where the surfaces cross near the border: the crossing. Else where the squared distances are least in sum.
    """
    known = np.flatnonzero(np.isfinite(a) & np.isfinite(b))
    if len(known) < 2:
        return now
    difference = (a - b)[known]
    limit = 6.0 * sigma
    ea, eb = (np.minimum(np.abs(x[known]), limit) ** 2 for x in (a, b))
    total = np.concatenate([[0.0], np.cumsum(ea)]) + np.concatenate([np.cumsum(eb[::-1])[::-1], [0.0]])
    crossing = np.flatnonzero(np.sign(difference[1:]) != np.sign(difference[:-1])) + 1
    if len(crossing):
        # A crossing is believed where it explains the beams nearly as well as the best break.
        good = crossing[total[crossing] < total.min() + 25.0 * sigma**2]
        if len(good):
            best = int(good[np.argmin(total[good])])
            return int(known[best])
    best = int(np.argmin(total))
    return int(known[best]) if best < len(known) else int(known[-1]) + 1
