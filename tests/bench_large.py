"""SLAM on a floor of offices: 1 km of way in many loops, with the simulated odometry and with worse.

    python tests/bench_large.py [seeds]

RMS and largest error of the trajectory after alignment, that of the odometry beside it, closures that hold and that
were refused, how well its covariance tells the error (normalised squared error over 3, of every 50th pose in the frame
of the first), seconds of the processor and scans each of them, and peak memory of the process with the simulation.
"""

import resource
import sys
import time
from dataclasses import replace

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.evaluate import align
from bsmap_cli.model import Trajectory
from bsmap_cli.params import SimulateParams, SlamParams
from bsmap_cli.simulate import simulate_scene
from bsmap_cli.slam import run_slam

ODOMETRY = (1.0, 4.0)
"""Times the odometry's error that is simulated by default."""


def main(seeds):
    print("odometry  seed  scans  RMS m   max m  odometry RMS  held refused  nees/3  slam s  scans/s  peak MB")
    for factor in ODOMETRY:
        for seed in range(seeds):
            print(row(factor, seed), flush=True)


def row(factor, seed):
    default = SimulateParams()
    params = replace(default, seed=seed, odometry_error=factor * default.odometry_error)
    simulation = simulate_scene("office", params)
    log, truth = replace(simulation.log, vertical=None), simulation.truth
    start = time.process_time()
    slam = run_slam(log, SlamParams())
    seconds = time.process_time() - start
    odometry = replace(slam.trajectory, poses=log.odometry)
    errors, raw = (align(found, truth) for found in (slam.trajectory, odometry))
    held = np.count_nonzero(slam.closures.held)
    n = len(log.horizontal.time_ns)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return (
        f"{factor:8.0f} {seed:5d} {n:6d} {errors.rms:6.3f} {errors.maximum:7.3f} {raw.rms:13.2f}"
        f" {held:5d} {len(slam.closures.held) - held:7d} {normalised(slam.trajectory, truth):7.2f} {seconds:7.1f}"
        f" {n / seconds:8.0f} {peak:8.0f}"
    )


def normalised(found: Trajectory, truth: Trajectory):
    """Mean squared error of every 50th pose over its covariance and 3."""
    at = np.searchsorted(truth.time_ns, found.time_ns)
    error = found.poses - se2.between(truth.poses[at[0]], truth.poses[at])
    error[:, 2] = se2.wrap(error[:, 2])
    some = np.arange(50, len(error), 50)
    solved = np.linalg.solve(found.covariances[some], error[some, :, None])[..., 0]
    return np.einsum("ni,ni->n", error[some], solved).mean() / 3


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
