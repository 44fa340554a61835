"""Scenes of known truth for the tests of all stages."""

from dataclasses import replace
from functools import cache

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.model import LineMap, ScanLog, SlamMap, StepStatistics, Trajectory
from bsmap_cli.params import SimulateParams
from bsmap_cli.simulate import Simulation, simulate_scene


@cache
def simulated(scene: str, **params: float) -> Simulation:
    """The simulation of a scene, computed once in a test run."""
    return simulate_scene(scene, SimulateParams(**params))


def first_scans(log: ScanLog, count: int) -> ScanLog:
    """The log of the first scans of both lasers."""
    lasers = [
        replace(laser, time_ns=laser.time_ns[:count], ranges=laser.ranges[:count])
        for laser in (log.horizontal, log.vertical)
    ]
    return ScanLog(lasers[0], None if log.odometry is None else log.odometry[:count], lasers[1])


def true_slam_map(simulation: Simulation, pose_covariance: np.ndarray | None = None) -> SlamMap:
    """What a perfect filter would deliver, without lines: true poses in the frame of the first one (map).

    pose_covariance : (3, 3) given to every pose (default: zero).
    """
    truth, log = simulation.truth, simulation.log
    at = np.searchsorted(truth.time_ns, log.horizontal.time_ns)
    poses = se2.between(truth.poses[at[0]], truth.poses[at])
    n = len(at)
    covariances = np.zeros((n, 3, 3)) if pose_covariance is None else np.tile(pose_covariance, (n, 1, 1))
    none = np.zeros(0, dtype=np.int64)
    counts = np.zeros(n, dtype=np.int64)
    return SlamMap(
        Trajectory(log.horizontal.time_ns, poses, covariances),
        LineMap(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)), none, none),
        StepStatistics(counts, counts, counts, np.zeros(n), counts),
        log.vertical,
        log.horizontal.mount,
    )
