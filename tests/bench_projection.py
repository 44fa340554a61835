"""Projection onto and evaluation of 40 x 20 bicubic surfaces: CPU time, failures against brute force, scipy beside it.

    OPENBLAS_NUM_THREADS=1 python tests/bench_projection.py

Times are the best of several runs. A projection counts with the sampling of its surface.
"""

import time

import numpy as np
from scipy.interpolate import NdBSpline, RectBivariateSpline
from scipy.spatial import cKDTree

from bsmap_cli.core.bspline import TensorSpline, clamped_knots, evaluate_grid, evaluate_surface
from bsmap_cli.core.descent import descend
from bsmap_cli.core.pieces import evaluate_pieces, polynomial_pieces
from bsmap_cli.core.projection import project
from bsmap_cli.core.sampling import sample_surface

POINTS = 10_000
SCATTERED = 1_000_000
GRID = 1000


def wavy_surface(rng, roughness):
    """Bicubic sheet of 40 x 20 control points, 8 m x 4 m, with noise of `roughness` metres on every control point."""
    knots_u, knots_v = (clamped_knots(3, np.arange(1, n - 3) / (n - 3)) for n in (40, 20))
    x, y = np.meshgrid(np.linspace(0, 8, 40), np.linspace(0, 4, 20), indexing="ij")
    sheet = np.stack([x, y, 0.5 * np.sin(x) * np.cos(y)], axis=2)
    return TensorSpline(3, 3, knots_u, knots_v, sheet + roughness * rng.standard_normal(sheet.shape))


def cpu_seconds(function, *arguments, repeats=3):
    """Least CPU time of several runs, and what the last one returns."""
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        result = function(*arguments)
        best = min(best, time.process_time() - start)
    return best, result


def brute_force(surface, points, starts=12):
    """Distances by descent from the closest of a million samples, and from the closest of coarser grids of them."""
    u, v = np.linspace(0, 1, 1300), np.linspace(0, 1, 800)
    grid = evaluate_grid(surface, u, v)
    pieces = polynomial_pieces(surface)
    best = np.full(len(points), np.inf)
    # Coarser grids of samples put the further starts apart from each other.
    for skip, count in ((1, 1), (10, starts), (25, starts)):
        _, near = cKDTree(grid[::skip, ::skip].reshape(-1, 3)).query(points, k=range(1, count + 1))
        for column in near.T:
            i, j = np.unravel_index(column, grid[::skip, ::skip].shape[:2])
            uv = np.stack([u[::skip][i], v[::skip][j]])
            uv = descend(pieces, points.T, uv, np.full(len(points), 0.1)).uv
            best = np.minimum(best, np.linalg.norm(evaluate_pieces(pieces, *uv)[0] - points.T, axis=0))
    return best


def projections():
    """Rows of the projection, and of small batches on samples at hand."""
    sizes = (1, 30, 1000)
    print(f"projection of {POINTS} points, with the sampling; share of them more than 1e-6 m worse than brute force;")
    print("small batches without the sampling, us a batch")
    print(
        f"{'roughness':>9} {'offset':>7} {'us/point':>9} {'sampling':>9} {'> 1e-6':>8} {'> 1e-4':>8} {'worst':>8}"
        + "".join(f" {f'n = {n}':>9}" for n in sizes)
    )
    for roughness in (0.0, 0.05, 0.2):
        for offset in (0.01, 0.1, 1.0):
            rng = np.random.default_rng(0)
            surface = wavy_surface(rng, roughness)
            points = evaluate_surface(surface, rng.random(POINTS), rng.random(POINTS))
            points = points + offset * rng.standard_normal(points.shape)
            sampling, samples = cpu_seconds(sample_surface, surface)
            seconds, found = cpu_seconds(project, surface, points, samples)
            excess = found.distance - brute_force(surface, points)
            batches = [cpu_seconds(project, surface, points[:n], samples)[0] * 1e6 for n in sizes]
            print(
                f"{roughness:9.2f} {offset:7.2f} {(sampling + seconds) / POINTS * 1e6:9.2f}"
                f" {sampling / POINTS * 1e6:9.2f} {np.mean(excess > 1e-6):8.3%} {np.mean(excess > 1e-4):8.3%}"
                f" {excess.max():8.0e}" + "".join(f" {batch:9.0f}" for batch in batches)
            )


def evaluations():
    """Rows of the evaluation beside scipy's own, nanoseconds a point."""
    rng = np.random.default_rng(1)
    surface = wavy_surface(rng, 0.05)
    u, v = rng.random((2, SCATTERED))
    at = np.linspace(0, 1, GRID)
    scipy_nd = NdBSpline((surface.knots_u, surface.knots_v), surface.control_points, 3)
    scipy_fit = RectBivariateSpline(np.linspace(0, 1, 40), np.linspace(0, 1, 20), surface.control_points[:, :, 0])
    uv = np.column_stack([u, v])
    orders = ((0, 0), (1, 0), (0, 1))
    rows = (
        ("scattered", SCATTERED, lambda: evaluate_surface(surface, u, v), lambda: scipy_nd(uv)),
        (
            "with first derivatives",
            SCATTERED,
            lambda: evaluate_surface(surface, u, v, 1),
            lambda: [scipy_nd(uv, nu=order) for order in orders],
        ),
        ("with second derivatives", SCATTERED, lambda: evaluate_surface(surface, u, v, 2), None),
        # Its spline has one coordinate.
        ("grid", GRID**2, lambda: evaluate_grid(surface, at, at), lambda: [scipy_fit(at, at) for _ in range(3)]),
    )
    print(f"evaluation of {SCATTERED} points, ns a point\n{'':>24} {'here':>7} {'scipy':>7}")
    for name, count, ours, theirs in rows:
        figures = [f"{cpu_seconds(run)[0] / count * 1e9:7.1f}" if run else f"{'':7}" for run in (ours, theirs)]
        print(f"{name:>24}", *figures)


if __name__ == "__main__":
    evaluations()
    projections()
