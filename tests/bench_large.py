"""SLAM on a floor of offices: 1 km of way in many loops, with the simulated odometry and with worse.

    python tests/bench_large.py [seeds]

RMS and largest error of the trajectory after alignment, that of the odometry beside it, closures that hold and that
were refused, how well its covariance tells the error (normalised squared error over 3, as in
bench_nees), seconds of the processor and scans each of them, and peak memory of the process with the simulation.
"""

import resource
import sys
import time
from dataclasses import replace

import numpy as np
from bench_nees import normalised_squared_error

from bsmap_cli.evaluate import align
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
    nees = normalised_squared_error(slam.trajectory, truth)
    held = np.count_nonzero(slam.closures.held)
    n = len(log.horizontal.time_ns)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return (
        f"{factor:8.0f} {seed:5d} {n:6d} {errors.rms:6.3f} {errors.maximum:7.3f} {raw.rms:13.2f}"
        f" {held:5d} {len(slam.closures.held) - held:7d} {nees:7.2f} {seconds:7.1f}"
        f" {n / seconds:8.0f} {peak:8.0f}"
    )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
