"""Placements of one map in another one, tried everywhere in the plane: correlation of walls over turn and shift.

Robots stand on the ground, so that turn, shift and height are all there is. Turns are those at which the walls of both
maps run parallel. For each, all shifts at once (by FFT) are judged by how much area of walls falls on walls that look
the same way at the same height, less that of walls that stand where the other map has seen the bare floor.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.fft import fft2, ifft2, next_fast_len
from scipy.ndimage import binary_dilation, binary_erosion, convolve, gaussian_filter1d, maximum_filter

from bsmap_cli.core import se2
from bsmap_cli.merge.bare import HIGH, LOW
from bsmap_cli.merge.oriented import Oriented
from bsmap_cli.model import Array

CELL = 0.2
"""Metres, of the grid over the plane."""
STOREY, STOREYS = 0.5, 12
"""Metres of height that are compared at once, and how many of them."""
TURNS, LEAST_TURN, MOST_TURNS = 720, 0.3, 16
"""Turns looked at, all around; share of the best one's agreement that a turn must have; most of them tried."""
PER_TURN = 12
"""Shifts kept of each turn."""
LEAST_SCORE = 1.0
"""Square metres that must speak for a placement."""
DENIED = 10.0
"""Square metres of walls on walls for which one that stands on bare floor speaks: furniture moves, walls do not."""


class Plan(NamedTuple):
    """Grid over the plane of a map.  low : (2,) its corner.  walls : (storeys, k, l) complex, area times normal.

    standing : (k, l) square metres of walls that stand on the floor.  bare : (k, l) whether bare floor was seen.
    """

    low: Array
    walls: Array
    standing: Array
    bare: NDArray[np.bool_]


def candidates(fixed: Oriented, moving: Oriented) -> Array:
    """(k, 3) poses of the moving map in the fixed one, of both the floor at z = 0, the best first."""
    plan, found = plan_of(fixed), []
    for turn in likely_turns(fixed, moving):
        other = plan_of(moving.moved(np.array([0.0, 0.0, turn]), 0.0))
        scores = _scores(plan, other)
        for i, j in _peaks(scores):
            shift = plan.low - other.low + CELL * (np.array([i, j]) - (np.array(other.bare.shape) - 1))
            found.append((float(scores[i, j]), *shift.tolist(), float(turn)))
    return np.array(sorted(found, reverse=True)).reshape(-1, 4)[:, 1:]


def likely_turns(fixed: Oriented, moving: Oriented) -> Array:
    """(k,) radians about which walls of both maps run parallel, the likeliest first."""
    a, b = _headings(fixed), _headings(moving)
    agreement = np.real(np.fft.ifft(np.fft.fft(a) * np.conj(np.fft.fft(b))))
    top = (agreement >= np.roll(agreement, 1)) & (agreement > np.roll(agreement, -1))
    best = np.flatnonzero(top & (agreement > LEAST_TURN * agreement.max()))
    best = best[np.argsort(-agreement[best], kind="stable")][:MOST_TURNS]
    return np.asarray(se2.wrap(2.0 * np.pi * best / TURNS))


def _headings(samples: Oriented) -> Array:
    """(TURNS,) square metres of walls by the heading of their normals."""
    walls = samples.of(samples.steep)
    heading = np.arctan2(walls.normals[:, 1], walls.normals[:, 0]) * TURNS / (2.0 * np.pi)
    counts = np.bincount(np.rint(heading).astype(int) % TURNS, walls.areas, TURNS)
    return np.asarray(gaussian_filter1d(counts, 1.0, mode="wrap"))


def plan_of(samples: Oriented) -> Plan:
    """The grid of a map whose floor lies at z = 0."""
    z = samples.points[:, 2]
    low = np.floor(samples.points[:, :2].min(axis=0) / CELL) * CELL
    cell = ((samples.points[:, :2] - low) / CELL).astype(int)
    shape = tuple(cell.max(axis=0) + 1)
    storey = np.floor(z / STOREY).astype(int)
    walls, standing, seen = np.zeros((STOREYS, *shape), dtype=complex), np.zeros(shape), np.zeros(shape, dtype=bool)
    used = samples.steep & (storey >= 0) & (storey < STOREYS)
    values = samples.areas * (samples.normals[:, 0] + 1j * samples.normals[:, 1])
    np.add.at(walls, (storey[used], *cell[used].T), values[used])
    used = samples.steep & (z > LOW) & (z < HIGH)
    np.add.at(standing, tuple(cell[used].T), samples.areas[used])
    seen[tuple(cell[samples.floor].T)] = True
    around = np.ones((3, 3), dtype=bool)
    return Plan(low, walls, standing, binary_erosion(seen, around) & ~binary_dilation(standing > 0.0, around))


def _scores(fixed: Plan, moving: Plan) -> Array:
    """(k, l) square metres for each shift, that of the moving grid's last cell onto the fixed one's first at [0, 0]."""
    size = np.add(fixed.bare.shape, moving.bare.shape) - 1
    shape = tuple(next_fast_len(int(n)) for n in size)
    blur = np.outer([0.5, 1.0, 0.5], [0.5, 1.0, 0.5])
    total = np.zeros(shape, dtype=complex)
    for a, b in zip(fixed.walls, moving.walls, strict=True):
        if np.any(a) and np.any(b):
            near = convolve(a, blur, mode="constant") / (CELL * STOREY)
            near /= np.maximum(np.abs(near), 1.0)
            total += fft2(near, shape) * fft2(np.conj(b[::-1, ::-1]), shape)
    for one, other in ((fixed.standing, moving.bare), (fixed.bare, moving.standing)):
        total -= DENIED * fft2(one, shape) * fft2(other[::-1, ::-1], shape)
    return np.asarray(np.real(ifft2(total))[: size[0], : size[1]])


def _peaks(scores: Array) -> list[tuple[int, int]]:
    """Highest places, none within two cells of a higher one."""
    top = (scores == maximum_filter(scores, 5, mode="constant", cval=-np.inf)) & (scores > LEAST_SCORE)
    at = np.argwhere(top)
    return [(int(i), int(j)) for i, j in at[np.argsort(-scores[top], kind="stable")[:PER_TURN]]]
