"""Noise of range finders, from the data themselves."""

import numpy as np
from numpy.typing import NDArray

# Of |a - 2 b + c| for unit normal noise: standard deviation sqrt(6), median 0.6745 times that.
_MEDIAN_OF_SECOND_DIFFERENCE = 0.6745 * np.sqrt(6.0)
FLOOR = 0.002
"""Metres; quantised or simulated ranges without noise still come from walls that are not perfect."""


def range_sigma(ranges: NDArray[np.floating], most: int = 200_000) -> float:
    """Standard deviation of the noise along the beam, metres, from second differences of ranges (n, m); nan: no return.

    A median, so that edges and clutter do not count; on a smooth wall the second difference is nearly pure noise. At
    most about `most` ranges, from scans evenly spread, are looked at. Without three returns in a row: 0.01.
    """
    step = max(1, ranges.size // most)
    second = np.abs(np.diff(ranges[::step].astype(float), 2, axis=1))
    second = second[np.isfinite(second)]
    if second.size == 0:
        return 0.01
    return max(FLOOR, float(np.median(second)) / _MEDIAN_OF_SECOND_DIFFERENCE)
