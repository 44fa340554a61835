"""The paper's map of the simulated room, true poses: surfaces before and after merging against the true scene.

    python tests/bench_merge.py [seeds]

Errors are weighted by area on a grid of at least four samples a span, or thin wild stretches between knots go unseen.
Doubled: area less the area that counts every place once, by the patches found within 0.1 m on the same side.
"""

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.evaluate import distance_to_mesh, transform_points
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.io.surfaces_json import write_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.overlap import land_parameters
from bsmap_cli.merge.patch import make_patch
from bsmap_cli.params import CloudParams, FitParams, MergeParams

FINE, COARSE, NEAR = 0.05, 0.15, 0.1  # m


def spaced(knots, length, step):
    """Middles and widths of cells, at least four in every span, about `step` metres long."""
    ends = np.unique(knots)
    counts = np.maximum(4, np.ceil(np.diff(ends) * length / step).astype(int))
    cells = [np.linspace(a, b, n + 1) for a, b, n in zip(ends[:-1], ends[1:], counts, strict=True)]
    return np.concatenate([(c[1:] + c[:-1]) / 2 for c in cells]), np.concatenate([np.diff(c) for c in cells])


def area_samples(patch, step):
    """Parameters (n,), (n,), points (n, 3) and the area (n,) that each stands for."""
    surface = patch.surface
    (u, du), (v, dv) = (
        spaced(knots, length, step)
        for knots, length in zip((surface.knots_u, surface.knots_v), patch.size, strict=True)
    )
    grid_u, grid_v = (g.ravel() for g in np.meshgrid(u, v, indexing="ij"))
    S, Su, Sv = evaluate_surface(surface, grid_u, grid_v, 1)
    return grid_u, grid_v, S, np.linalg.norm(np.cross(Su, Sv), axis=1) * np.outer(du, dv).ravel()


def doubled_area(patches):
    total = single = 0.0
    for a in patches:
        u, v, _, weights = area_samples(a, COARSE)
        layers = 1 + sum(land_parameters(a, u, v, b, NEAR).hit.astype(int) for b in patches if b is not a)
        total += weights.sum()
        single += (weights / layers).sum()
    return total - single, total


def errors(patches, simulation):
    """Distances (n,) to the true scene and areas (n,); the map's frame is the first true pose."""
    start = simulation.truth.poses[np.searchsorted(simulation.truth.time_ns, simulation.log.horizontal.time_ns[0])]
    samples = [area_samples(patch, FINE) for patch in patches]
    points = transform_points(start, np.concatenate([s[2] for s in samples]))
    distances = distance_to_mesh(points, simulation.vertices, simulation.triangles)
    return distances, np.concatenate([s[3] for s in samples])


def row(name, surface_map, simulation, cloud):
    patches = [make_patch(surface) for surface in surface_map.surfaces]
    distances, areas = errors(patches, simulation)
    order = np.argsort(distances)
    share = np.cumsum(areas[order]) / areas.sum()
    median, high = distances[order][np.searchsorted(share, [0.5, 0.95])]
    doubled, total = doubled_area(patches)
    controls = sum(s.control_points.shape[0] * s.control_points.shape[1] for s in surface_map.surfaces)
    print(
        f"{name:>14} {len(patches):8d} {controls:8d} {(distances @ areas) / areas.sum() * 1e3:8.1f}"
        f" {median * 1e3:8.1f} {high * 1e3:8.1f} {distances.max() * 1e3:8.0f} {total:8.1f} {doubled:8.1f}"
        f" {bytes_of(surface_map) / (12 * len(cloud.points)):8.1%}"
    )


def bytes_of(surface_map):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.json"
        write_surfaces(path, surface_map)
        return path.stat().st_size


def main(seeds=1):
    print(
        f"{'':>14} {'surfaces':>8} {'controls':>8} {'mean mm':>8} {'median':>8} {'95%':>8} {'max':>8}"
        f" {'area m2':>8} {'doubled':>8} {'of cloud':>8}"
    )
    for seed in range(seeds):
        simulation = simulated("room", seed=seed)
        cloud = make_cloud(true_slam_map(simulation), CloudParams())
        fitted = fit_surfaces(cloud, FitParams(method="paper"))
        row(f"seed {seed} fit", fitted, simulation, cloud)
        start = time.process_time()
        result = merge_surfaces([fitted], MergeParams())
        seconds = time.process_time() - start
        row("merged", result, simulation, cloud)
        print(f"{'':>14} {seconds:.1f} CPU seconds, {result.notes}")
        for (outcome, reason), count in Counter(
            (d.outcome, d.reason.partition(";")[0]) for d in result.decisions
        ).most_common():
            print(f"{'':>14} {count:5d} {outcome}: {reason}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
