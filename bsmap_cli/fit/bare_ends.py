"""Ends of faces at which nothing is met: the next beam of the scan goes on behind the face.

Where the neighbouring scan sees the face go on, as beyond the edge of a door, whose lintel ends the wall above: what
lies between the two scans is not known. The cells there are cut from the end to the first beam of the other scan that
lies no farther along the scan.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.ends import THROUGH, Ends
from bsmap_cli.fit.feet import tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.fit.labels import OUTLIER, met_at
from bsmap_cli.fit.outline import CORNERS
from bsmap_cli.model import IntArray

BEHIND = 0.03
"""Metres beyond the noise by which the next beam must go on behind the face."""


def beyond_bare_ends(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], ends: Ends) -> NDArray[np.bool_]:
    """(4, m - 1, n - 1) corners of cells, in the order of CORNERS, that lie beyond an end that the other scan shows.

    The grid's points lie on their faces. A cell of one face loses one corner at most: with less it would be lost.
    """
    m, n = labels.shape
    out = np.zeros((4, m - 1, n - 1), dtype=bool)
    for side in (0, 1):
        row, column = np.nonzero(_bare(grid, labels, fields, ends, side))
        place = grid.points[row, ends.last[side, row, column]]
        way = place - grid.points[row, ends.inner[side, row, column]]
        way /= np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
        for up, step in [(up, step) for up in (-1, 1) for step in (-1, 0, 1)]:
            q, c = row + up, column + step
            at = np.flatnonzero((q >= 0) & (q < m) & (c >= 0) & (c < n))
            goes_on = (labels[q[at], c[at]] == labels[row[at], column[at]]) & (ends.last[side, q[at], c[at]] != c[at])
            at = at[goes_on & grid.hit[q[at], c[at]]]
            at = at[np.sum((grid.points[q[at], c[at]] - place[at]) * way[at], axis=1) > THROUGH]
            _mark(out, row[at], column[at], up, step)
    corners = np.stack([labels[:-1, :-1], labels[:-1, 1:], labels[1:, 1:], labels[1:, :-1]])
    return out & ~(np.all(corners == corners[0], axis=0) & (out.sum(axis=0) > 1))


def _mark(out: NDArray[np.bool_], row: IntArray, column: IntArray, up: int, step: int) -> None:
    """Mark beams `up` scans and `step` beams away from beams (k,) in the cells that hold both."""
    for first in {min(step, 0), max(step, 0) - 1}:
        r, c = row + min(up, 0), column + first
        inside = (c >= 0) & (c < out.shape[2])
        out[CORNERS.index((max(up, 0), step - first)), r[inside], c[inside]] = True


def _bare(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], ends: Ends, side: int) -> NDArray[np.bool_]:
    """(m, n) beams of runs that end openly on one side, the next beam going on behind their face."""
    m, n = labels.shape
    row, column = np.nonzero((ends.last[side] >= 0) & (ends.face[side] < 0))
    last = ends.last[side, row, column]
    following = np.clip(last + 2 * side - 1, 0, n - 1)
    ended = grid.hit[row, following] & (labels[row, following] != labels[row, column])
    behind = np.zeros((m, n), dtype=bool)
    first = np.unique(row * n + last, return_index=True)[1]
    first = first[ended[first]]
    face = labels[row[first], column[first]]
    met = met_at(grid, tabulate(fields), face, row[first], following[first])
    behind[row[first], last[first]] = met.beyond < -BEHIND - OUTLIER * grid.sigma
    out = np.zeros((m, n), dtype=bool)
    out[row, column] = behind[row, last]
    return out
