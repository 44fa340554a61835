"""Seconds of the processor that merging takes for more and more data sets, all at once: repeated surveys of one room.

    python tests/bench_merge_cost.py [data sets at most]

The room is simulated and fitted once at true poses; further surveys are drawn from it: heights within their covariance.
"""

import sys
import time
from dataclasses import replace

import numpy as np
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.core.gaussian import symmetric_sqrt
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.bases import has_base
from bsmap_cli.params import CloudParams, FitParams, MergeParams

POSE = np.diag([1e-3**2, 1e-3**2, 1e-4**2])
"""Given to all data sets, so that their poses are adjusted; no errors are drawn from it."""


def drawn(surface, rng):
    """The surface with heights drawn from their covariance."""
    covariance = surface.covariance
    pose = tuple(replace(part, covariance=POSE) for part in covariance.pose)
    points = surface.control_points
    if has_base(surface):
        heights = symmetric_sqrt(covariance.matrix) @ rng.standard_normal(len(covariance.matrix))
        points = points + heights.reshape(points.shape[:2])[..., None] * covariance.directions
    return replace(surface, control_points=points, covariance=replace(covariance, pose=pose))


def main(most=200):
    fitted = fit_surfaces(make_cloud(true_slam_map(simulated("room")), CloudParams()), FitParams(method="faces"))
    sets, rng = len(fitted.data_sets), np.random.default_rng(0)
    print(f"{'sets':>5} {'faces':>6} {'of map':>6} {'decisions':>9} {'s':>7} {'s a set':>8}")
    for count in (1, 2, 4, 8, 16, 28):
        if sets * count > int(most):
            break
        surveys = [replace(fitted, surfaces=tuple(drawn(s, rng) for s in fitted.surfaces)) for _ in range(count)]
        start = time.process_time()
        merged = merge_surfaces(surveys, MergeParams())
        seconds = time.process_time() - start
        faces = count * len(fitted.surfaces)
        row = f"{sets * count:5d} {faces:6d} {len(merged.surfaces):6d} {len(merged.decisions):9d}"
        print(f"{row} {seconds:7.1f} {seconds / (sets * count):8.3f}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
