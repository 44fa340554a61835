"""Projection of 10,000 points onto 40 x 20 bicubic surfaces: CPU microseconds a point, failures against brute force.

python tests/bench_projection.py
"""

import time

import numpy as np
from scipy.spatial import cKDTree

from bsmap_cli.core.bspline import TensorSpline, clamped_knots, evaluate_grid, evaluate_surface
from bsmap_cli.core.projection import _descend, project, sample_surface

POINTS = 10_000


def wavy_surface(rng, roughness):
    """Bicubic sheet of 40 x 20 control points, 8 m x 4 m, with noise of `roughness` metres on every control point."""
    knots_u, knots_v = (clamped_knots(3, np.arange(1, n - 3) / (n - 3)) for n in (40, 20))
    x, y = np.meshgrid(np.linspace(0, 8, 40), np.linspace(0, 4, 20), indexing="ij")
    sheet = np.stack([x, y, 0.5 * np.sin(x) * np.cos(y)], axis=2)
    return TensorSpline(3, 3, knots_u, knots_v, sheet + roughness * rng.standard_normal(sheet.shape))


def brute_force(surface, points, starts=12):
    """Distances by descent from the `starts` closest of a million samples and all local minima among them."""
    u, v = np.linspace(0, 1, 1300), np.linspace(0, 1, 800)
    grid = evaluate_grid(surface, u, v)
    tree = cKDTree(grid.reshape(-1, 3))
    distance, index = tree.query(points)
    i, j = np.unravel_index(index, grid.shape[:2])
    best = np.minimum(distance, distances(surface, points, u[i], v[j]))
    # Coarser grids of samples put the further starts apart from each other.
    for skip in (10, 25):
        tree = cKDTree(grid[::skip, ::skip].reshape(-1, 3))
        _, near = tree.query(points, k=starts)
        for column in near.T:
            i, j = np.unravel_index(column, grid[::skip, ::skip].shape[:2])
            best = np.minimum(best, distances(surface, points, u[::skip][i], v[::skip][j]))
    return best


def distances(surface, points, u, v):
    found = _descend(surface, points, u, v)
    return np.linalg.norm(found.jets[0] - points, axis=1)


def main():
    print(f"{'roughness':>9} {'offset':>7} {'us/point':>9} {'sampling':>10} {'> 1e-6':>9} {'> 1e-4':>9} {'worst':>9}")
    for roughness in (0.0, 0.05, 0.2):
        for offset in (0.01, 0.1, 1.0):
            rng = np.random.default_rng(0)
            surface = wavy_surface(rng, roughness)
            points = evaluate_surface(surface, rng.random(POINTS), rng.random(POINTS))
            points = points + offset * rng.standard_normal(points.shape)
            start = time.process_time()
            samples = sample_surface(surface)
            made = time.process_time()
            found = project(surface, points, samples)
            end = time.process_time()
            excess = found.distance - brute_force(surface, points)
            print(
                f"{roughness:9.2f} {offset:7.2f} {(end - start) / POINTS * 1e6:9.2f} {(made - start) * 1e3:10.1f}"
                f" {np.mean(excess > 1e-6):9.3%} {np.mean(excess > 1e-4):9.3%} {excess.max():9.1e}"
            )


if __name__ == "__main__":
    main()
