"""The beams of a data set as a grid of scans and beams: points, directions, ranges."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.beams import beam_origins
from bsmap_cli.model import Array, IntArray, PointCloud


class Sums(NamedTuple):
    """Of the returns before each beam of a grid of m scans of n beams.

    number : (m n + 1,) of them in the grid before each beam, scan after scan.  place : (k,) flat index of each return.
    sums : (m, n + 1, 7) of their points, directions and beam numbers in the scan before each beam.
    """

    number: IntArray
    place: IntArray
    sums: Array


@dataclass(frozen=True, eq=False)
class BeamGrid:
    """Beams of m scans, n each; nan where nothing came back.

    points : (m, n, 3) in map.  directions : (m, n, 3) unit vectors of the beams in map.  ranges : (m, n) metres.
    angles : (n,) of the beams in the scan plane, radians.  hit : (m, n) whether there is a return.
    sigma : metres, noise along the beam.
    """

    points: Array
    directions: Array
    ranges: Array
    angles: Array
    hit: NDArray[np.bool_]
    sigma: float

    @cached_property
    def before(self) -> Sums:
        """Sums of returns, added up once: then the mean of any stretch of beams is had from its two ends."""
        m, n = self.hit.shape
        number = np.zeros(m * n + 1, dtype=np.int64)
        np.cumsum(self.hit.ravel(), out=number[1:])
        sums = np.zeros((m, n + 1, 7))
        seen = self.hit[:, :, None]
        sums[:, 1:, :3] = np.where(seen, self.points, 0.0)
        sums[:, 1:, 3:6] = np.where(seen, self.directions, 0.0)
        sums[:, 1:, 6] = self.hit * np.arange(n)
        np.cumsum(sums, axis=1, out=sums)
        return Sums(number, np.flatnonzero(self.hit), sums)


def make_grid(cloud: PointCloud, scans: IntArray) -> BeamGrid:
    """Beams of the scans `scans` (m,), ascending; scans without any return are left out.

    The cloud tells each beam's end; its begin is had from the scans' poses, at the time of the beam.
    """
    start, stop = np.searchsorted(cloud.scan_index, np.stack([scans, scans + 1]))
    kept = np.flatnonzero(stop > start)
    index = np.concatenate([np.arange(start[k], stop[k]) for k in kept] + [np.zeros(0, dtype=np.int64)]).astype(int)
    row = np.repeat(np.arange(len(kept)), stop[kept] - start[kept])
    beams = cloud.beam_index[index]
    first = int(beams.min()) if len(beams) else 0
    n = int(beams.max(initial=first)) - first + 1
    column = beams - first
    points, directions = np.full((2, len(kept), n, 3), np.nan)
    ranges, hit = np.full((len(kept), n), np.nan), np.zeros((len(kept), n), dtype=bool)
    along = cloud.points[index] - beam_origins(cloud, index)
    length = np.linalg.norm(along, axis=1)
    points[row, column], ranges[row, column], hit[row, column] = cloud.points[index], length, True
    directions[row, column] = along / length[:, None]
    angles = cloud.angle_min + cloud.angle_increment * (first + np.arange(n))
    return BeamGrid(
        points, directions, ranges, np.asarray(angles, dtype=np.float64), hit, _noise(ranges, cloud.range_sigma)
    )


def _noise(ranges: Array, stated: float) -> float:
    """Standard deviation of a range: from second differences along the scan lines; as stated without three in a row."""
    second = np.abs(np.diff(ranges, 2, axis=1))
    second = second[np.isfinite(second)]
    if len(second) < 100:
        return stated
    return max(float(np.median(second)) / (0.6745 * np.sqrt(6.0)), 0.1 * stated)
