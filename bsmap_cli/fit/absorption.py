"""Small faces that larger ones explain better, given up: a slanted one across the corner of two, say."""

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.clutter import INCIDENCE
from bsmap_cli.fit.feet import Table, tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.fit.labels import ADOPTED, met_at
from bsmap_cli.fit.pieces import JUNK_BEAM
from bsmap_cli.fit.selection import PRICE
from bsmap_cli.model import Array, IntArray

SMALL = 200
"""Beams of a face that is asked whether others explain it: ones of more have shape enough of their own."""
REACH = 1.0
"""Metres by which a face may be continued to explain beams."""


def absorb(grid: BeamGrid, labels: IntArray, fields: list[HeightField], sigma: float) -> IntArray:
    """Labels without the small faces whose beams the larger ones explain at a lower price; the smallest go first.

    The price of a face is the chi square of its beams and that of its control points; that of the others is the chi
    square to the best of them, for beams that none explains that of junk. Beams go to the best one, or to the rest.
    """
    labels, table = labels.copy(), tabulate(fields)
    count = np.bincount(labels[(labels >= 0) & grid.hit], minlength=len(fields))
    for number in np.argsort(count, kind="stable").tolist():
        mask = (labels == number) & grid.hit
        if count[number] > SMALL or not mask.any():
            continue
        larger = np.flatnonzero(count > count[number])
        chi = _chi(grid, table, np.append(larger, number), mask, sigma)
        own, others = chi[-1].sum() + PRICE * fields[number].knots.size, chi[:-1]
        least = others.min(axis=0, initial=JUNK_BEAM)
        if least.sum() < own:
            labels[labels == number] = -1
            if len(larger):
                labels[mask] = np.where(least < ADOPTED**2, larger[others.argmin(axis=0)], -1)
            count[number] = 0
    return labels


def _chi(grid: BeamGrid, table: Table, faces: IntArray, mask: NDArray[np.bool_], sigma: float) -> Array:
    """(f, k) chi square of the beams of a mask to faces (f,), at most that of junk, where the face may reach them."""
    row, column = np.nonzero(mask)
    face = np.repeat(faces, len(row))
    met = met_at(grid, table, face, np.tile(row, len(faces)), np.tile(column, len(faces)))
    room = (REACH / table.size).T[face]
    near = np.all((met.uv > -room) & (met.uv < 1.0 + room), axis=1) & (np.abs(met.slope) > INCIDENCE)
    chi = np.where(near, np.minimum((met.beyond / sigma) ** 2, JUNK_BEAM), JUNK_BEAM)
    return np.asarray(chi.reshape(len(faces), -1))
