"""Calibration of the trajectory's covariance: python tests/bench_nees.py [SEEDS] [SCENE ...]

Mean normalised squared error of the poses of all scans, relative to the first, over its 3 degrees of freedom (1 is
right), and the RMS error after alignment.
"""

import sys

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.evaluate import align
from bsmap_cli.model import Trajectory
from bsmap_cli.params import SimulateParams, SlamParams
from bsmap_cli.simulate import simulate_scene
from bsmap_cli.slam import run_slam


def normalised_squared_error(estimate: Trajectory, truth: Trajectory) -> float:
    """Mean over the poses but the first, over 3."""
    true = se2.interpolate(truth.time_ns, truth.poses, estimate.time_ns)
    error = (se2.between(true[:1], true) - estimate.poses)[1:]
    error[:, 2] = se2.wrap(error[:, 2])
    return float(np.einsum("ni,nij,nj->n", error, np.linalg.inv(estimate.covariances[1:]), error).mean() / 3)


def main(seeds: int, scenes: list[str]) -> None:
    """Print a row a scene."""
    print(f"{'scene':10} {'seeds':>5} {'nees/3':>7} {'least':>6} {'most':>6} {'RMS mm':>7} {'worst':>6}")
    for scene in scenes:
        figures = []
        for seed in range(seeds):
            made = simulate_scene(scene, SimulateParams(seed=seed))
            found = run_slam(made.log, SlamParams()).trajectory
            figures.append((normalised_squared_error(found, made.truth), 1e3 * align(found, made.truth).rms))
        nees, rms = np.array(figures).T
        print(
            f"{scene:10} {seeds:5} {nees.mean():7.3f} {nees.min():6.2f} {nees.max():6.2f}"
            f" {rms.mean():7.2f} {rms.max():6.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20, sys.argv[2:] or ["room", "corridor", "loop"])
