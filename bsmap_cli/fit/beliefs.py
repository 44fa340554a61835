"""What faces tell of the noise, and which of them are believed: those that explain the beams they were made of."""

from collections.abc import Sequence

import numpy as np

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.clutter import NOISY
from bsmap_cli.fit.context import FLATNESS
from bsmap_cli.fit.labels import OUTLIER
from bsmap_cli.fit.misses import Misses, without_outliers
from bsmap_cli.fit.selection import PRICE, Fitted
from bsmap_cli.model import IntArray

KEPT = 0.9
"""Share of its beams that a face must explain."""
SURE = 3.0
"""Standard deviations of a mean of squares by which a face may miss its beams more than faces that are believed."""
LEAST_SQUARE = 0.25
"""By which the faces may lower the variance of the noise."""


def scale_left(fitted: Sequence[Fitted], blocks: Sequence[Blocks]) -> float:
    """Standard deviation that blocks have about their faces over the one assumed, 1 at most.

    Second differences and lines take corners and bends for noise; faces follow them. Of those that fit worse than half
    of the blocks would let expect, nothing is told.
    """
    size = np.array([f.field.knots.size for f in fitted], dtype=np.int64)
    freedom = np.array([len(of.counts) for of in blocks], dtype=np.int64) - size
    square = np.array([f.criterion - PRICE * f.field.knots.size for f in fitted])
    known = np.flatnonzero(freedom > 4 * size)
    if not len(known):
        return 1.0
    freedom, square = freedom[known], square[known] / freedom[known]
    order = np.argsort(square)
    middle = square[order][np.searchsorted(np.cumsum(freedom[order]), 0.5 * freedom.sum())]
    sound = square < middle * (1.0 + SURE * np.sqrt(2.0 / freedom))
    return float(np.sqrt(np.clip(np.average(square[sound], weights=freedom[sound]), LEAST_SQUARE, 1.0)))


def believed(grid: BeamGrid, misses: Misses, sigma: float, noise: float) -> IntArray:
    """Labels without outliers, nor the faces that many of their beams deny, or that miss them by more than the noise.

    A surface that bridges a step, or a few of them, lies within the gate of outliers of most beams, but not as near to
    them as noise and unevenness would have it.
    """
    labels = without_outliers(misses, sigma)
    member = (misses.labels >= 0) & grid.hit
    before = np.bincount(misses.labels[member])
    near = member & (np.abs(misses.beyond) < OUTLIER * noise)
    some = np.maximum(np.bincount(misses.labels[near], minlength=len(before)), 1)
    square = np.bincount(misses.labels[near], misses.beyond[near] ** 2, len(before)) / some
    most = NOISY**2 * (noise**2 + FLATNESS**2) * (1.0 + SURE * np.sqrt(2.0 / some))
    after = np.bincount(labels[(labels >= 0) & grid.hit], minlength=len(before))
    denied = np.append((after < KEPT * before) | (square > most), False)
    labels[denied[labels]] = -1
    return labels
