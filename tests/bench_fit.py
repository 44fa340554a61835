"""The paper's experiment: 20-scan translation sets of the room at true poses, degrees 1 to 3 with the paper's bounds.

    python tests/bench_fit.py [seeds]

Errors in millimetres. data: from the points to the surface at their parameters. truth: from the surface at the points'
parameters to the true scene, all points, and those within 3 beams of a corner of the true scan line. The paper has
mean errors of 32.5, 19.2 and 13.1 mm for degrees 1, 2, 3, about 60 mm at corners, and the fewest control points for
degree 3. What that order hangs on is told by changing one thing at a time: the noise, the number of control points, and
the shape of the scene (a vault without corners).

What comes out: least error in the data and fewest control points for degree 3, both, come only in the vault under the
default rule with noise. Without noise degree 3 needs the fewest there, but is not the closest. With the same number of
control points the order comes in the vault where they are few; in the room at 16 x 6, not at 8 x 5 nor at 64 x 12. Less
error in the data need not be less to the truth. Why the room keeps no such order under the bounds is not known: it
fails without noise, too.
"""

import logging
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.core.bspline import TensorSpline, clamped_knots, evaluate_surface
from bsmap_cli.core.gaussian import pack
from bsmap_cli.evaluate import distance_to_mesh, transform_points
from bsmap_cli.fit.curves import Rows, centripetal, fit_curves
from bsmap_cli.fit.lines import ScanLines, gather_lines
from bsmap_cli.fit.movement import divide
from bsmap_cli.fit.surface import fit_scan_lines, mean_centripetal
from bsmap_cli.params import CloudParams, FitParams

RULES = {
    "bounds and the noise beyond them": FitParams(),
    "bounds as they stand": FitParams(noise_margin=0.0, knots_per_pass=5),
    "bounds three times as wide, as they stand": FitParams(bound_u=0.03, bound_v=0.15, noise_margin=0.0),
}

BUDGETS = ((8, 5), (16, 6), (32, 8), (64, 12))
"""Control points along and across, the same for all degrees."""


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
    """Translation sets of one seed, where their corners are, and the distance of points (n, 3) in map to the truth."""

    sets: list
    corners: list
    distance: Callable


def room(seed, sigma):
    """Translation sets of the room."""
    sets, bends = [], []
    simulation, clean = (simulated("room", seed=seed, range_sigma=s) for s in (sigma, 0.0))
    noise = CloudParams(range_sigma=max(sigma, 1e-6))
    clouds = [make_cloud(true_slam_map(s), noise) for s in (simulation, clean)]
    for movement in divide(clouds[0].scan_poses, 5.0):
        if movement.kind == "translation":
            noisy, true = (gather_lines(cloud, movement, 8) for cloud in clouds)
            sets.append(noisy)
            bends.append(corners(true.points, true.line))
    first = np.searchsorted(simulation.truth.time_ns, simulation.log.horizontal.time_ns[0])
    start, mesh = simulation.truth.poses[first], (simulation.vertices, simulation.triangles)
    return Scene(sets, bends, lambda points: distance_to_mesh(transform_points(start, points), *mesh))


VAULT_RADIUS = 2.0


def vault(seed, sigma):
    """One set of 20 scans by 541 beams, 0.1 m apart, in a round tunnel along x, 0.6 m off its axis."""
    scan, phi = np.repeat(np.arange(20), 541), np.tile(np.radians(np.linspace(-135, 135, 541)), 20)
    y, z, off = np.sin(phi), np.cos(phi), 0.6
    ranges = -off * z + np.sqrt(VAULT_RADIUS**2 - (off * y) ** 2)
    ranges = ranges + sigma * np.random.default_rng(seed).normal(size=len(ranges))
    points = np.column_stack([0.1 * scan, ranges * y, off + ranges * z])
    beams = np.column_stack([np.zeros_like(y), y, z])
    noise = max(sigma, 1e-6) ** 2 * beams[:, :, None] * beams[:, None, :]
    lines = ScanLines(points, scan, pack(noise))
    return Scene([lines], [np.zeros(len(y), bool)], lambda p: np.abs(np.hypot(p[:, 1], p[:, 2]) - VAULT_RADIUS))


def measure(place, lines, bends, spline, u, v, seconds):
    fitted = evaluate_surface(spline, u, v[lines.line])
    data = np.linalg.norm(fitted - lines.points, axis=1)
    truth = place.distance(fitted)
    corner = truth[bends] if bends.any() else np.full(1, np.nan)
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


def by_number(place, lines, bends, degree, nu, nv):
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


def jobs(make, seeds, sigma):
    places = [make(seed, sigma) for seed in range(seeds)]
    return [(p, lines, bends) for p in places for lines, bends in zip(p.sets, p.corners, strict=True)]


def with_rule(work, params):
    return {d: [by_rule(*job, replace(params, degree_u=d, degree_v=d)) for job in work] for d in (1, 2, 3)}


def main(seeds):
    logging.disable(logging.WARNING)
    for name, make in (("room", room), ("vault", vault)):
        for sigma in (0.0, 0.01, 0.03):
            work = jobs(make, seeds, sigma)
            lines = work[0][1]
            print(f"\n## {name}, sigma {1e3 * sigma:.0f} mm: means over {len(work)} sets of {lines.n_lines} scans")
            for title, params in RULES.items():
                # Noise of three times the bound is more than any number of knots can follow.
                if sigma < 0.03 or params.noise_margin > 0:
                    show(title, with_rule(work, params))
            for nu, nv in BUDGETS:
                rows = {d: [by_number(*job, d, nu, nv) for job in work] for d in (1, 2, 3)}
                show(f"{nu} x {nv} control points, even knots", rows)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
