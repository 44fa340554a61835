"""How beams miss their faces, and which leave them for it: outliers, neighbours that miss alike, ends that slip."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.context import FLATNESS
from bsmap_cli.fit.feet import STEEPEST, meet, tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.fit.labels import OUTLIER, by_face, met_at
from bsmap_cli.model import Array, IntArray

SLIPPED = 2.0
"""Standard deviations, of noise and flatness together, within which the last beam stays before a jump
that misses its face towards the next."""
ALIKE = ((3, 3), (7, 1))
"""Scans and beams of neighbourhoods whose misses are added up."""
CHUNK = 20_000
"""Beams whose neighbourhoods are added up at a time."""


class Misses(NamedTuple):
    """Labels (m, n), and metres (m, n) from the point on to the beam's face, along the beam.

    0 for beams without face; infinite for those that only graze it, and may pass it.
    """

    labels: IntArray
    beyond: Array


def find_misses(
    grid: BeamGrid,
    labels: IntArray,
    fields: Sequence[HeightField],
    known: Misses | None = None,
    before: Misses | None = None,
) -> Misses:
    """How all beams miss their faces.

    known : the same for other labels, which is kept where these agree.  before : the same for fields near these ones.
    """
    beyond = np.zeros(labels.size) if known is None else np.where(labels >= 0, known.beyond, 0.0).ravel()
    new = (labels >= 0) & grid.hit
    if known is not None:
        new &= labels != known.labels
    at = by_face(np.flatnonzero(new), labels, len(fields))
    start = None
    if before is not None:
        start = np.where(before.labels.ravel()[at] >= 0, before.beyond.ravel()[at], 0.0)
        start[~np.isfinite(start)] = 0.0
    points, directions = grid.points.reshape(-1, 3), grid.directions.reshape(-1, 3)
    met = meet(tabulate(fields), labels.ravel()[at], points, directions, at, start)
    beyond[at] = np.where(np.abs(met.slope) > STEEPEST, met.beyond, np.inf)
    return Misses(labels, beyond.reshape(labels.shape))


def without_outliers(misses: Misses, sigma: float) -> IntArray:
    """Labels without the beams that miss their face by more than noise, or that graze it."""
    return np.where(np.abs(misses.beyond) < OUTLIER * sigma, misses.labels, -1)


def without_alike(grid: BeamGrid, misses: Misses, sigma: float) -> IntArray:
    """Labels without the beams that miss their face by less than an outlier, but together with their neighbours.

    The side of a recess that is no deeper than the gate of outliers would otherwise be shared out to the faces above
    and below it.
    """
    labels = misses.labels
    member = (labels >= 0) & grid.hit
    miss = np.clip(misses.beyond / sigma, -OUTLIER, OUTLIER)
    own = np.where(member, labels, -1)
    alike = np.zeros(labels.shape, dtype=bool)
    for window in ALIKE:
        total, count = _window_sums(own, miss, window)
        alike |= member & (np.abs(total) > OUTLIER * np.sqrt(count)) & (miss * total > 0.0)
    return np.where(alike, -1, labels)


def without_slipped_ends(grid: BeamGrid, misses: Misses, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Labels without those last beams of runs that are on their way to where the scan goes on beyond a jump.

    A beam at the edge of a jump may have hit what lies between (the side of a recess, a wall of which only one scan
    tells): then it misses its face on the side on which the next beam does, and neither face behind it fits.
    """
    labels, table = misses.labels.copy(), tabulate(fields)
    for step in (-1, 1):
        row, column = np.nonzero(
            (labels >= 0) & (np.abs(misses.beyond) > SLIPPED * np.hypot(sigma, FLATNESS)) & grid.hit
        )
        following = column + step
        inside = (following >= 0) & (following < labels.shape[1])
        row, column, following = row[inside], column[inside], following[inside]
        face, other = misses.labels[row, column], misses.labels[row, following]
        ends = (other != face) & grid.hit[row, following]
        row, column, following, face, other = (of[ends] for of in (row, column, following, face, other))
        own, next_one = misses.beyond[row, column], met_at(grid, table, face, row, following).beyond
        gone = (np.sign(own) * np.sign(next_one) > 0.0) & (np.abs(next_one) > np.abs(own))
        meets = np.flatnonzero(gone & (other >= 0))
        to_other = met_at(grid, table, other[meets], row[meets], column[meets]).beyond
        gone[meets] = np.abs(to_other) > OUTLIER * sigma
        labels[row[gone], column[gone]] = -1
    return labels


def _window_sums(own: IntArray, values: Array, window: tuple[int, int]) -> tuple[Array, Array]:
    """(m, n) sums of the values of beams of the same face in a window around each, and their number."""
    (m, n), reach = own.shape, (window[0] // 2, window[1] // 2)
    margins = [(r, r) for r in reach]
    faces, padded = np.pad(own.astype(np.int32), margins, constant_values=-1), np.pad(values, margins)
    total, count = np.zeros(own.shape), np.zeros(own.shape)
    step = max(1, CHUNK // n)
    # So many scans at once stay in the processor's cache.
    for first in range(0, m, step):
        rows = slice(first, min(first + step, m))
        centre = faces[reach[0] :][rows, reach[1] : reach[1] + n]
        for i, k in itertools.product(range(window[0]), range(window[1])):
            same = faces[i:][rows, k : k + n] == centre
            total[rows] += np.where(same, padded[i:][rows, k : k + n], 0.0)
            count[rows] += same
    return total, count
