"""Parameters that scan lines share: points of one beam lie at one u in all scans, points of one scan at one v.

The noise of a scan makes its own centripetal parameters waver, and with them the control points that the second step
fits across the scans; averaged over the scans they are nearly those of points without noise. Then they are moved to
where the curves come nearest to the points of all scans at once (Hoschek's intrinsic parameters, Computer Aided
Geometric Design 5, 1988, in common): a jump from one scan to the next gets room there, and few knots follow it.
"""

import numpy as np

from bsmap_cli.fit.curves import Rows, row_ends
from bsmap_cli.model import Array, IntArray

FARTHEST = 0.4
"""Of the step to the neighbour, by which a parameter may move at once: their order stays."""


def shared_centripetal(points: Array, row: IntArray, place: IntArray) -> Array:
    """Parameters (n,), from 0 to 1 in each row, of points (n, 3): steps as sqrt of the chord lengths, averaged.

    Each step between two places is the mean over the rows, of which each counts alike; a chord over places where its
    row has no point counts in equal parts for them.

    Parameters
    ----------
    row : (n,) ascending.  place : (n,) number of the beam, ascending in each row.
    """
    chords = np.sqrt(np.linalg.norm(np.diff(points, axis=0), axis=1))
    inside = np.flatnonzero(row[1:] == row[:-1])
    length = np.bincount(row[inside], chords[inside], int(row[-1]) + 1)
    gaps = place[inside + 1] - place[inside]
    share = chords[inside] / np.where(length > 0.0, length, 1.0)[row[inside]] / gaps
    of_step = np.repeat(place[inside] - (np.cumsum(gaps) - gaps), gaps) + np.arange(gaps.sum())
    known = np.bincount(of_step, minlength=int(place.max()))
    steps = np.bincount(of_step, np.repeat(share, gaps), len(known)) / np.maximum(known, 1)
    along = np.concatenate([[0.0], np.cumsum(steps)])[place]
    first, last = row_ends(row)
    span = along[last] - along[first]
    if np.any(span <= 0.0):
        along, span = place.astype(float), (place[last] - place[first]).astype(float)
    counts = last - first + 1
    u = (along - np.repeat(along[first], counts)) / np.repeat(np.maximum(span, 1e-300), counts)
    u[last[counts > 1]] = 1.0
    return np.clip(u, 0.0, 1.0)


def common_steps(place: IntArray, tangents: Array, residuals: Array) -> Array:
    """Step (places,) of Gauss and Newton towards the feet of points, in common for all of one place.

    Parameters
    ----------
    place : (n, k).  tangents, residuals : (n, k, 3) at the parameters; residuals from there to the points.
    """
    along, squares = (
        np.bincount(place.ravel(), np.einsum("nkd,nkd->nk", tangents, of).ravel()) for of in (residuals, tangents)
    )
    return along / np.maximum(squares, 1e-300)


def moved(rows: Rows, step: Array) -> Rows:
    """Rows with their shared parameters moved by steps (places,), shortened where order asks for it; ends stay."""
    assert rows.place is not None
    room = np.full(len(step), np.inf)
    gaps = np.where(rows.row[1:] == rows.row[:-1], np.diff(rows.u), np.inf)
    np.minimum.at(room, rows.place, np.minimum(np.append(gaps, np.inf), np.append(np.inf, gaps)))
    step = np.clip(step, -FARTHEST * room, FARTHEST * room)[rows.place]
    step[np.concatenate(row_ends(rows.row))] = 0.0
    return rows._replace(u=rows.u + step)
