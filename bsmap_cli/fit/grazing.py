"""Scans that only graze a face at its end, given to the face of the next scan where that explains them as well.

A scan in the plane that touches a pillar's side lies on the pillar and on the wall behind it, within the noise. To the
pillar it tells next to nothing, but bends its end; the wall it meets steeply.
"""

from collections.abc import Sequence

import numpy as np

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.feet import tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.fit.labels import met_at, runs_of
from bsmap_cli.model import Array, IntArray

GRAZED = 0.2
"""Mean change of a face's height along the beams of a run that may be another face's: over a base, the sine between."""
STEEPER = 2.0
"""Times that change, which the beams must have at the other face."""
TIE = 25.0
"""Chi square by which the other face may explain a run worse, but no more than 1 a beam."""


def without_grazed_ends(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Labels (m, n), runs that graze the end of a face given to the face in the next scan before their middle."""
    labels, table = labels.copy(), tabulate(fields)
    for step in (-1, 1):
        runs = runs_of(labels)
        following = np.clip(runs.row + step, 0, len(labels) - 1)
        other = labels[following, (runs.start + runs.stop) // 2]
        ends = np.flatnonzero((other >= 0) & (other != runs.label))
        row, start, stop, label, other = (of[ends] for of in (*runs, other))
        length = stop - start
        of = np.repeat(np.arange(len(ends)), length)
        column = np.arange(len(of)) - np.repeat(np.cumsum(length) - length, length) + start[of]
        hit = grid.hit[row[of], column]
        of, column = of[hit], column[hit]
        chi, slope = np.empty((2, len(ends))), np.empty((2, len(ends)))
        for k, face in enumerate((label, other)):
            met = met_at(grid, table, face[of], row[of], column)
            chi[k] = np.bincount(of, (met.beyond / sigma) ** 2, len(ends))
            slope[k] = _means(np.abs(met.slope), of, len(ends))
        worse = np.minimum(TIE, np.bincount(of, minlength=len(ends)))
        given = (slope[0] < GRAZED) & (slope[1] > STEEPER * slope[0]) & (chi[1] < chi[0] + worse)
        labels[row[of[given[of]]], column[given[of]]] = other[of[given[of]]]
    return labels


def _means(values: Array, of: IntArray, count: int) -> Array:
    """(count,) means of values (n,) by their number (n,)."""
    return np.asarray(np.bincount(of, values, count) / np.maximum(np.bincount(of, minlength=count), 1))
