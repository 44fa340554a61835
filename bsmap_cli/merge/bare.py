"""Floor on which nothing stands: where one map shows it, another one can have no wall, or something moved."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_dilation, binary_erosion

from bsmap_cli.merge.oriented import STEP, Oriented
from bsmap_cli.model import Array

LOW, HIGH = 0.15, 1.8
"""Metres above the floor between which a wall stands in the way of a robot: there the floor tells that none is."""


class Bare(NamedTuple):
    """Where a map shows floor and no wall on it.  low : (2,) corner of the grid.  cells : (k, l).  floor : metres."""

    low: Array
    cells: NDArray[np.bool_]
    floor: float

    def under(self, points: Array) -> NDArray[np.bool_]:
        """(n,) whether there is bare floor under points (n, 3) at which a wall would stand in the way of a robot."""
        cell = np.floor((points[:, :2] - self.low) / STEP).astype(int)
        inside = np.all((cell >= 0) & (cell < self.cells.shape), axis=1)
        inside &= (points[:, 2] > self.floor + LOW) & (points[:, 2] < self.floor + HIGH)
        inside[inside] = self.cells[tuple(cell[inside].T)]
        return inside


def bare_floor(samples: Oriented) -> Bare:
    """Floor less what is nearer than about two cells to its border or to a wall that stands on it.

    Where a map lacks a wall, as one of few scans does, its floor ends there all the same.
    """
    low = np.floor(samples.points[:, :2].min(axis=0) / STEP) * STEP
    cell = np.floor((samples.points[:, :2] - low) / STEP).astype(int)
    floor, z, level = samples.floor, samples.points[:, 2], floor_level(samples)
    seen, walls = np.zeros((2, *(cell.max(axis=0) + 1)), dtype=bool)
    seen[tuple(cell[floor].T)] = True
    walls[tuple(cell[samples.steep & (z > level + LOW) & (z < level + HIGH)].T)] = True
    around = np.ones((3, 3), dtype=bool)
    inner = binary_erosion(binary_closing(np.pad(seen, 2), around), around, 2)[2:-2, 2:-2]
    return Bare(low, inner & ~binary_dilation(walls, around), level)


def floor_level(samples: Oriented) -> float:
    """Height of the floor, metres in map; 0, on which robots stand, where none was seen."""
    floor = samples.floor
    return float(np.median(samples.points[floor, 2])) if floor.any() else 0.0
