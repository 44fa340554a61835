"""The paper's experiment: 20-scan translation sets of the room at true poses, degrees 1 to 3 with the paper's bounds.

    python tests/bench_fit.py [seeds]

Errors in millimetres. data: from the points to the surface at their parameters. truth: from the surface at the points'
parameters to the true scene, all points, and those within 3 beams of a corner of the true scan line. The paper has
mean errors of 32.5, 19.2 and 13.1 mm for degrees 1, 2, 3, about 60 mm at corners, and the fewest control points for
degree 3.
"""

import logging
import sys
import time
from typing import NamedTuple

import numpy as np
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.core.bspline import TensorSpline, clamped_knots, evaluate_surface
from bsmap_cli.evaluate import distance_to_mesh, transform_points
from bsmap_cli.fit.curves import Rows, centripetal, fit_curves
from bsmap_cli.fit.lines import gather_lines
from bsmap_cli.fit.movement import divide
from bsmap_cli.fit.surface import fit_scan_lines, mean_centripetal
from bsmap_cli.params import CloudParams, FitParams

RULES = {
    "bounds and the noise beyond them": FitParams(),
    "bounds as they stand": FitParams(noise_margin=0.0, knots_per_pass=5),
    "bounds three times as wide, as they stand": FitParams(bound_u=0.03, bound_v=0.15, noise_margin=0.0),
}


class Row(NamedTuple):
    """Figures of one fit: control points along and across, errors in metres, CPU seconds."""

    nu: float
    nv: float
    data_mean: float
    data_max: float
    truth_mean: float
    truth_95: float
    truth_max: float
    corner_mean: float
    corner_max: float
    seconds: float


def corners(points, line, reach=3, angle=np.pi / 4):
    """(n,) bool, points near which the true scan line bends by more than `angle`."""
    before, after = points - np.roll(points, reach, axis=0), np.roll(points, -reach, axis=0) - points
    cosine = np.einsum("nk,nk->n", before, after)
    cosine /= np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    same = (np.roll(line, reach) == line) & (np.roll(line, -reach) == line)
    # A jump of range is no corner.
    near = np.maximum(np.linalg.norm(before, axis=1), np.linalg.norm(after, axis=1)) < 0.5
    return same & near & (cosine < np.cos(angle))


class Scene(NamedTuple):
    """Translation sets of one seed with their true points, and the mesh."""

    sets: list
    corners: list
    start: np.ndarray
    simulation: object


def scene(seed):
    sets, bends = [], []
    simulation, clean = simulated("room", seed=seed), simulated("room", seed=seed, range_sigma=0.0)
    clouds = [make_cloud(true_slam_map(s), CloudParams(range_sigma=0.01)) for s in (simulation, clean)]
    for movement in divide(clouds[0].scan_poses, 5.0):
        if movement.kind == "translation":
            noisy, true = (gather_lines(cloud, movement, 8) for cloud in clouds)
            sets.append(noisy)
            bends.append(corners(true.points, true.line))
    first = np.searchsorted(simulation.truth.time_ns, simulation.log.horizontal.time_ns[0])
    return Scene(sets, bends, simulation.truth.poses[first], simulation)


def measure(place, lines, bends, spline, u, v, seconds):
    fitted = evaluate_surface(spline, u, v[lines.line])
    data = np.linalg.norm(fitted - lines.points, axis=1)
    at = transform_points(place.start, fitted)
    truth = distance_to_mesh(at, place.simulation.vertices, place.simulation.triangles)
    corner = truth[bends]
    return Row(
        *spline.control_points.shape[:2],
        data.mean(),
        data.max(),
        truth.mean(),
        np.percentile(truth, 95),
        truth.max(),
        corner.mean(),
        corner.max(),
        seconds,
    )


def by_rule(place, lines, bends, params):
    start = time.process_time()
    fit = fit_scan_lines(lines, params)
    return measure(place, lines, bends, fit.spline, fit.u, fit.v, time.process_time() - start)


def by_number(place, lines, bends, degree, nu=40, nv=12):
    """The same number of control points for all degrees, knots at even parameters."""
    start = time.process_time()
    knots_u, knots_v = (clamped_knots(degree, np.arange(1, n - degree) / (n - degree)) for n in (nu, nv))
    u = centripetal(lines.points, lines.line)
    along = fit_curves(Rows(u, lines.line, lines.points[:, None], np.zeros((len(u), 1))), knots_u, degree)
    columns = along.control_points[:, :, 0]
    v = mean_centripetal(columns)
    across = fit_curves(Rows(v, np.zeros(len(v), dtype=int), columns, np.zeros(columns.shape[:2])), knots_v, degree)
    control_points = np.swapaxes(across.control_points[0], 0, 1)
    spline = TensorSpline(degree, degree, knots_u, knots_v, control_points)
    return measure(place, lines, bends, spline, u, v, time.process_time() - start)


def show(title, rows_of_degree):
    print(f"\n{title}")
    print("degree  control points  data mean    max  truth mean    95%    max  corner mean    max  seconds")
    for degree, rows in rows_of_degree.items():
        mean = Row(*np.mean(rows, axis=0))
        points = f"{mean.nu:5.1f} x {mean.nv:4.1f}"
        mm = [f"{1e3 * x:6.1f}" for x in mean[2:9]]
        print(
            f"{degree:6d} {points:>15} {mm[0]:>10} {mm[1]:>6} {mm[2]:>11} {mm[3]:>6} {mm[4]:>6} {mm[5]:>12} {mm[6]:>6}"
            f" {mean.seconds:8.2f}"
        )


def main(seeds):
    logging.disable(logging.WARNING)
    places = [scene(seed) for seed in range(seeds)]
    work = [(p, lines, bends) for p in places for lines, bends in zip(p.sets, p.corners, strict=True)]
    print(
        f"{len(work)} sets of {work[0][1].n_lines} scans, {len(work[0][1].points)} points, sigma 10 mm; means over sets"
    )
    for title, params in RULES.items():
        rows = {}
        for degree in (1, 2, 3):
            changed = FitParams(**{**vars(params), "degree_u": degree, "degree_v": degree})
            rows[degree] = [by_rule(*job, changed) for job in work]
        show(title, rows)
    show("40 x 12 control points, even knots", {d: [by_number(*job, d) for job in work] for d in (1, 2, 3)})


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
