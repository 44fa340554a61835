"""Small faces in what is left: planes through neighbouring beams of no face, grown from those of the best support.

Narrow faces (the side of a recess, a window's reveal) have too few beams in a scan for a piece, and furniture breaks
scan lines into many; together with the neighbouring scans they are planes all the same. Each beam of the rest is asked
for the best plane through it and two of its neighbours, and planes grow from the best of these.
"""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from scipy import ndimage

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.model import Array, IntArray

FEWEST, FEWEST_SCANS = 16, 3
"""Beams and scans of a plane."""
AROUND = (2, 3)
"""Scans and beams to each side of a beam that support the plane through it."""
ALONG = ((0, -3), (0, -2), (0, -1), (0, 1), (0, 2), (0, 3))
ACROSS = tuple(itertools.product((-2, -1, 1, 2), (-1, 0, 1)))
"""Scans and beams from a beam to the two others of a plane through it."""
CLOSE = 2.0
"""Standard deviations along the beam within which neighbours support a plane."""
LEAST_SUPPORT = 6
"""Beams."""
CHUNK = 2000
"""Beams whose planes are looked at together."""
WITHIN = 3.0
"""Standard deviations along the beam that a plane's beams may lie off it."""
NOISY = 1.25
"""Standard deviations that they may in the mean of squares: points spread evenly over the gate have 1.7."""
INCIDENCE = 0.15
"""Smallest sine between beams and plane."""
EIGHT = np.ones((3, 3), dtype=int)


class _Rest(NamedTuple):
    """Beams of no face: scan and beam (k, 2), points and directions (k, 3); and the number of each in the grid (m, n).

    number : -1 where there is none.  sigma : metres, noise along the beam.
    """

    place: IntArray
    points: Array
    directions: Array
    number: IntArray
    sigma: float

    def beyond(self, which: IntArray, origin: Array, normal: Array) -> Array:
        """Standard deviations along the beam from the beams `which` (k,) to a plane; infinite where it is grazed."""
        sine = self.directions[which] @ normal
        height = (self.points[which] - origin) @ normal
        steep = np.abs(sine) > INCIDENCE
        return np.where(steep, np.abs(height) / (self.sigma * np.where(steep, np.abs(sine), 1.0)), np.inf)


def find_planes(grid: BeamGrid, labels: IntArray, sigma: float) -> IntArray:
    """Labels with new numbers for planes found among the beams of no face."""
    labels = labels.copy()
    mask = (labels < 0) & grid.hit
    number = np.full(labels.shape, -1)
    number[mask] = np.arange(np.count_nonzero(mask))
    rest = _Rest(np.argwhere(mask), grid.points[mask], grid.directions[mask], number, sigma)
    support, normals = _best_planes(rest)
    tried = np.zeros(len(support), dtype=bool)
    for seed in np.argsort(-support, kind="stable").tolist():
        if support[seed] < LEAST_SUPPORT:
            break
        if tried[seed]:
            continue
        members, believed = _grown(rest, seed, normals[seed])
        # What has grown from one beam would grow from the others, too.
        tried[members if len(members) >= FEWEST else seed] = True
        if believed:
            at = tuple(rest.place[members].T)
            labels[at] = labels.max() + 1
            number[at] = -1
    return labels


def _best_planes(rest: _Rest) -> tuple[IntArray, Array]:
    """Of each beam (k,) how many support the best plane through it and two others, itself included; normals (k, 3)."""
    support, normals = np.zeros(len(rest.place), dtype=np.int64), np.zeros((len(rest.place), 3))
    number = np.pad(rest.number, [(a, a) for a in AROUND], constant_values=-1)
    for first in range(0, len(support), CHUNK):
        own = np.arange(first, min(first + CHUNK, len(support)))
        steps = list(itertools.product(*(range(-a, a + 1) for a in AROUND)))
        around = np.stack([number[tuple((rest.place[own] + AROUND + step).T)] for step in steps])
        # Those with fewer neighbours than that find no plane to be looked at.
        enough = np.count_nonzero(around >= 0, axis=0) >= LEAST_SUPPORT
        own, around = own[enough], around[:, enough]
        if not len(own):
            continue
        window = dict(zip(steps, around, strict=True))
        offsets, directions = rest.points[around] - rest.points[own], rest.directions[around]
        for a, b in itertools.product(ALONG, ACROSS):
            known = np.flatnonzero((window[a] >= 0) & (window[b] >= 0))
            normal = np.cross(*(rest.points[window[step][known]] - rest.points[own[known]] for step in (a, b)))
            sine = np.abs(np.einsum("jki,ki->jk", directions[:, known], normal))
            height = np.abs(np.einsum("jki,ki->jk", offsets[:, known], normal))
            steep = sine > INCIDENCE * np.linalg.norm(normal, axis=1)
            close = steep & (height < CLOSE * rest.sigma * sine) & (around[:, known] >= 0)
            count = close.sum(axis=0)
            better = count > support[own[known]]
            support[own[known[better]]], normals[own[known[better]]] = count[better], normal[better]
    return support, normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)


def _grown(rest: _Rest, seed: int, normal: Array) -> tuple[IntArray, bool]:
    """Beams (k,) of the plane that grows from a beam, in ever wider windows around it; and whether it is believed."""
    origin, members = rest.points[seed], np.array([seed])
    for window in _windows(rest, seed):
        free = window >= 0
        image = np.zeros(window.shape, dtype=bool)
        miss = rest.beyond(window[free], origin, normal)
        image[free] = miss < WITHIN
        patches, _ = ndimage.label(image, EIGHT)
        own = patches[window == seed]
        before, members = members, window[(patches == own) & image]
        if len(members) < LEAST_SUPPORT:
            return np.append(members, seed), False
        if np.array_equal(before, members):
            break
        origin = rest.points[members].mean(axis=0)
        normal = np.linalg.eigh(np.cov((rest.points[members] - origin).T))[1][:, 0]
    miss = rest.beyond(members, origin, normal)
    enough = len(members) >= FEWEST and len(np.unique(rest.place[members, 0])) >= FEWEST_SCANS
    return members, bool(enough and np.sqrt(np.mean(miss**2)) < NOISY)


def _windows(rest: _Rest, seed: int) -> Iterator[IntArray]:
    """Numbers of the beams in windows around one, each twice as wide as the one before, the widest twice more."""
    (m, n), (row, column) = rest.number.shape, rest.place[seed].tolist()
    scale, rounds = 1, 0
    while rounds < 3:
        up, side = scale * (AROUND[0] + 1), scale * (AROUND[1] + 1)
        yield rest.number[max(0, row - up) : row + up + 1, max(0, column - side) : column + side + 1]
        rounds += up >= m and side >= n
        scale *= 2
