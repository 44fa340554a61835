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

    def pick(self, keep: IntArray | NDArray[np.bool_] | slice) -> "Blocks":
        """The blocks that an index, a mask (k,) or a slice names."""
        points, directions, counts, row, column, owner = self
        return Blocks(points[keep], directions[keep], counts[keep], row[keep], column[keep], owner[keep])


def make_blocks(grid: BeamGrid, row: IntArray, start: IntArray, stop: IntArray) -> Blocks:
    """Blocks of runs of beams: row (k,), first beam (k,), beam behind the last one (k,)."""
    n = grid.ranges.shape[1]
    number, place, sums = grid.before
    some = np.flatnonzero(number[row * n + stop] > number[row * n + start])
    row, start, length = row[some], start[some], (stop - start)[some]
    first, last = (place[number[row * n + end] - k] for end, k in ((start, 0), (stop[some], 1)))
    points = grid.points.reshape(-1, 3)
    metres = np.sqrt(np.sum((points[last] - points[first]) ** 2, axis=1))
    # Equal shares of a run: as many blocks as the number of beams, or the length in metres, asks for.
    share = np.ceil(np.maximum(length / LARGEST, metres / LONGEST)).astype(np.int64).clip(FEWEST)
    share = np.minimum(share, length)
    of = np.repeat(np.arange(len(share)), share)
    part = np.arange(len(of)) - np.repeat(np.cumsum(share) - share, share)
    low, high = (start[of] - -k * length[of] // share[of] for k in (part, part + 1))
    counts = number[row[of] * n + high] - number[row[of] * n + low]
    seen = np.flatnonzero(counts)
    of, low, high, counts = of[seen], low[seen], high[seen], counts[seen].astype(np.float64)
    mean = (sums[row[of], high] - sums[row[of], low]) / counts[:, None]
    return Blocks(mean[:, :3], _unit(mean[:, 3:6]), counts, row[of], mean[:, 6], some[of])


def single_beams(grid: BeamGrid, row: IntArray, start: IntArray, stop: IntArray) -> Blocks:
    """The beams of runs, each for itself: row (k,), first beam (k,), beam behind the last one (k,)."""
    n = grid.ranges.shape[1]
    number, place, _ = grid.before
    first = number[row * n + start]
    count = number[row * n + stop] - first
    flat = place[np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)]
    points, directions = (of.reshape(-1, 3)[flat] for of in (grid.points, grid.directions))
    return Blocks(
        points, directions, np.ones(len(flat)), flat // n, flat % n * 1.0, np.repeat(np.arange(len(row)), count)
    )


def _unit(vectors: Array) -> Array:
    return vectors / np.sqrt(np.sum(vectors**2, axis=1, keepdims=True))


def thinned(blocks: Blocks, beams: int = LARGEST, narrow: float = NARROW) -> Blocks:
    """Blocks of one face of up to so many beams, those of scans that lie within `narrow` metres taken together.

    Over so short a way even a pillar is flat to less than what the noise leaves of a mean. Scans farther apart stay.
    """
    if len(blocks.row) < 2 or np.ptp(blocks.row) < FEWEST_ROWS:
        return blocks
    row, cell = blocks.row - blocks.row.min(), (blocks.column / beams).astype(np.int64)
    cell -= cell.min()
    cells = int(cell.max()) + 1
    at = np.full((int(row.max()) + 1, cells), -1)
    at[row, cell] = np.arange(len(row))
    before, behind = at[:-1][both := (at[:-1] >= 0) & (at[1:] >= 0)], at[1:][both]
    if not len(before):
        return blocks
    steps = np.sqrt(np.sum((blocks.points[behind] - blocks.points[before]) ** 2, axis=1))
    scans = int(min(narrow / np.quantile(steps, 0.95), np.ptp(row) / FEWEST_ROWS)) + 1
    if scans < 2:
        return blocks
    key = (blocks.row // scans - blocks.row.min() // scans) * cells + cell
    counts = np.bincount(key, blocks.counts).astype(np.float64)
    kept = np.flatnonzero(counts)
    head = np.empty(len(counts), dtype=np.int64)
    head[key[::-1]] = np.arange(len(key))[::-1]
    head, counts = head[kept], counts[kept]
    values = (*blocks.points.T, *blocks.directions.T, blocks.column)
    mean = np.stack([np.bincount(key, of * blocks.counts)[kept] / counts for of in values], axis=1)
    return Blocks(mean[:, :3], _unit(mean[:, 3:6]), counts, blocks.row[head], mean[:, 6], blocks.owner[head])
