"""Delay between the stamps of laser and odometry, found by how the robot's turns line up; many robots have one."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.model import Array, IntArray, ScanLog

LEAST_DELAY, MOST_DELAY, STEP = 0.03, 0.5, 0.01
"""Seconds, to both sides: shorter ones do no harm, and scans farther apart tell nothing; and between those tried."""
FEWEST = 100
"""Turns between matched scans without which nothing is told."""
LARGEST_TURN = 0.5
"""Radians: what goes beyond may be a slip or a false match and counts as this much."""
CLEAR = 0.6
"""Share of the turns' disagreement at the opposite delay that may be left, for a delay to be believed. Between stamps
the odometry is interpolated, which evens out its noise and lowers the disagreement, but to both sides alike."""


def odometry_delay(time_ns: IntArray, poses: Array, odometry: Array, matched: NDArray[np.bool_]) -> float:
    """Seconds by which the scans come after the odometry of the same moment; 0 where that is not clear.

    The turns from one matched scan to the next are compared with those of the odometry so much earlier (Olson 2010,
    passive synchronisation, finds clocks by the same thought).

    time_ns : (n,) stamps.  poses : (n, 3) as tracked.  odometry : (n, 3) at the stamps.  matched : (n,) scans placed
    by a match.
    """
    seconds = (time_ns - time_ns[0]) * 1e-9
    # What the odometry told before the first scan and after the last one is not known.
    scans = np.flatnonzero(matched & (seconds >= MOST_DELAY) & (seconds <= seconds[-1] - MOST_DELAY))
    between = np.diff(seconds)
    if len(scans) <= FEWEST or between.min() <= 0.0 or np.median(between) > MOST_DELAY:
        return 0.0
    heading = np.unwrap(odometry[:, 2])
    seen = _turns(np.unwrap(poses[:, 2])[scans])
    steps = int(MOST_DELAY / STEP)
    delays = STEP * np.arange(-steps, steps + 1)
    told = [_turns(np.interp(seconds[scans] - delay, seconds, heading)) for delay in delays]
    if np.std(seen) == 0.0 or min(np.std(turns) for turns in told) == 0.0:
        return 0.0
    apart = 1.0 - np.array([np.corrcoef(seen, turns)[0, 1] for turns in told]) ** 2
    best = int(np.argmin(apart))
    clear = apart[best] < CLEAR * apart[-1 - best] and abs(best - steps) * STEP >= LEAST_DELAY
    return float(delays[best]) if clear else 0.0


def _turns(heading: Array) -> Array:
    return np.clip(np.diff(heading), -LARGEST_TURN, LARGEST_TURN)


def lined_up(log: ScanLog, delay: float) -> ScanLog:
    """The log with the odometry of `delay` seconds before each scan's stamp, the moment at which it was taken."""
    assert log.odometry is not None
    time_ns = log.horizontal.time_ns
    return replace(log, odometry=se2.interpolate(time_ns, log.odometry, time_ns - round(delay * 1e9)))
