"""SLAM: ScanLog -> SlamMap.

By default scans are matched to the map of the last ones (tracking), places seen before are recognised and the
trajectory is smoothed (loops, posegraph), and the line filter maps the walls along it, which sharpen it once more
(lines, smoothing). With `method` "paper" the line filter works alone, as in the paper.
"""

import numpy as np

from bsmap_cli.core.noise import range_sigma
from bsmap_cli.errors import BadInputError
from bsmap_cli.model import ScanLog, SlamMap
from bsmap_cli.params import SlamParams
from bsmap_cli.slam.graph import run_graph
from bsmap_cli.slam.paper import run_paper
from bsmap_cli.track import Track, silent


def run_slam(log: ScanLog, params: SlamParams, *, track: Track = silent) -> SlamMap:
    """Trajectory and line map of a log; the map's frame is base_link at the first scan.

    Raises
    ------
    BadInputError
        The log has no horizontal scan with a return in it.
    """
    scans = log.horizontal
    if len(scans.time_ns) == 0 or not np.isfinite(scans.ranges).any():
        raise BadInputError(f"the horizontal laser ({scans.topic}) has no scan with a valid range")
    sigma = params.range_sigma or range_sigma(scans.ranges)
    run = run_paper if params.method == "paper" else run_graph
    return run(log, sigma, params, track)
