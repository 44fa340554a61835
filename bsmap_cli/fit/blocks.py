"""Block means of neighbouring beams: an eighth of the data, and nearly the same surface."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.model import Array, IntArray

LARGEST = 8
"""Beams of a block."""
FEWEST = 3
"""Blocks of a run, if it has so many beams: one alone would not tell how the surface lies along the scan."""
LONGEST = 0.2
"""Metres from the first to the last beam of a block: over it a surface must be flat to much less than the noise."""
NARROW = 0.02
"""Metres from the first to the last scan of blocks taken together."""
FEWEST_ROWS = 20
"""Rows of blocks that must be left of a face."""


class Blocks(NamedTuple):
    """Means of neighbouring beams of one scan line.

    points : (k, 3) in map.  directions : (k, 3) unit.  counts : (k,) beams.  row, column : (k,) scan and mean beam.
    owner : (k,) number of the run they come from, ascending.
    """

    points: Array
    directions: Array
    counts: Array
    row: IntArray
    column: Array
    owner: IntArray

    def pick(self, keep: IntArray | NDArray[np.bool_]) -> "Blocks":
        """The blocks that an index or a mask (k,) names."""
        points, directions, counts, row, column, owner = self
        return Blocks(points[keep], directions[keep], counts[keep], row[keep], column[keep], owner[keep])


def make_blocks(grid: BeamGrid, row: IntArray, start: IntArray, stop: IntArray, largest: int = LARGEST) -> Blocks:
    """Blocks of runs of beams: row (k,), first beam (k,), beam behind the last one (k,)."""
    length = stop - start
    n = grid.ranges.shape[1]
    position = np.arange(int(length.sum())) - np.repeat(np.cumsum(length) - length, length)
    flat = np.repeat(row * n + start, length) + position
    owner = np.repeat(np.arange(len(row)), length)
    hit = grid.hit.ravel()[flat]
    flat, owner, position = flat[hit], owner[hit], position[hit]
    if len(flat) == 0:
        none = np.zeros(0, dtype=np.int64)
        return Blocks(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), none, np.zeros(0), none)
    points = grid.points.reshape(-1, 3)[flat]
    # Equal shares of a run: as many blocks as the number of beams, or the length in metres, asks for.
    ends = np.zeros((len(row), 2, 3))
    ends[owner[::-1], 0], ends[owner, 1] = points[::-1], points
    metres = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    share = np.ceil(np.maximum(length / largest, metres / LONGEST)).astype(np.int64).clip(FEWEST)
    number = position * np.minimum(share, length)[owner] // length[owner]
    first = np.flatnonzero((np.diff(owner, prepend=-1) != 0) | (np.diff(number, prepend=-1) != 0))
    counts = np.diff(np.append(first, len(flat))).astype(float)
    mean = np.add.reduceat(np.column_stack([points, grid.directions.reshape(-1, 3)[flat], flat % n]), first, axis=0)
    mean /= counts[:, None]
    directions = mean[:, 3:6] / np.linalg.norm(mean[:, 3:6], axis=1, keepdims=True)
    return Blocks(mean[:, :3], directions, counts, flat[first] // n, mean[:, 6], owner[first])


def thinned(blocks: Blocks) -> Blocks:
    """Blocks of one face, those of neighbouring scans taken together as long as these lie within NARROW.

    Over so short a way even a pillar is flat to less than what the noise leaves of a mean. Scans farther apart stay.
    """
    cell = (blocks.column / LARGEST).astype(np.int64)
    order = np.lexsort((blocks.row, cell))
    successive = (np.diff(cell[order]) == 0) & (np.diff(blocks.row[order]) == 1)
    if not successive.any():
        return blocks
    steps = np.linalg.norm(np.diff(blocks.points[order], axis=0)[successive], axis=1)
    scans = int(min(NARROW / np.quantile(steps, 0.95), np.ptp(blocks.row) / FEWEST_ROWS)) + 1
    if scans < 2:
        return blocks
    group = blocks.row // scans
    order = np.lexsort((cell, group))
    first = np.flatnonzero((np.diff(cell[order], prepend=-1) != 0) | (np.diff(group[order], prepend=-1) != 0))
    weight = blocks.counts[order]
    counts = np.add.reduceat(weight, first)
    values = np.column_stack([blocks.points, blocks.directions, blocks.column])[order]
    mean = np.add.reduceat(values * weight[:, None], first) / counts[:, None]
    directions = mean[:, 3:6] / np.linalg.norm(mean[:, 3:6], axis=1, keepdims=True)
    head = order[first]
    return Blocks(mean[:, :3], directions, counts, blocks.row[head], mean[:, 6], blocks.owner[head])
