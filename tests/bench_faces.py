"""Faces of data sets of known truth, and of a real room: what `bsmap fit --method faces` reaches.

    python tests/bench_faces.py [seeds]

rms, max: millimetres from the faces at the feet of their beams to the true scene.
ratio: rms over the statistical limit sigma * sqrt(control points / beams).
all: rms from the true points of all beams to the trimmed surfaces, capped at 0.1 m.
stray: samples of the surfaces farther than 3 cm from the truth, per thousand.
far: samples farther from any raw point than 3 cm beyond the spacing of the beams there, per thousand.
through: beams that pass through a surface more than 3 cm, beyond their noise, before their end, per thousand.
inside: per cent of the feet whose error the 95% interval of the sensor part holds.
Means over seeds; max is the largest.
"""

import sys
import time
from typing import NamedTuple

import numpy as np
from face_scenes import (
    barrel_vault,
    corridor_set,
    dome,
    egg,
    passing_set,
    real_room,
    ring,
    simulated_place,
    tunnel,
    turning_set,
)
from scipy.spatial import cKDTree

from bsmap_cli import open3d_loader
from bsmap_cli.evaluate import distance_to_mesh, surface_samples
from bsmap_cli.export.tessellation import tessellate
from bsmap_cli.fit import divide
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.faces import fit_set
from bsmap_cli.fit.heights import basis_matrix, evaluate
from bsmap_cli.fit.labels import OUTLIER, feet_of_faces
from bsmap_cli.model import SurfaceMap

CAP = 0.1
CHI2_95 = 3.84


class Row(NamedTuple):
    faces: float
    control_points: float
    share: float
    sigma: float
    rms: float
    ratio: float
    largest: float
    all_beams: float
    stray: float
    far: float
    through: float
    inside: float
    find_seconds: float
    seconds: float


def height_variance(fitted, uv):
    """Variance (n,) across the surface at parameters (n, 2)."""
    N = basis_matrix(fitted.field.knots, uv)
    tilt = 1.0 + np.sum(evaluate(fitted.field, uv)[1] ** 2, axis=1)
    return np.sum((N @ np.linalg.inv(fitted.information)) * N, axis=1) / tilt


def joined(meshes):
    """Vertices and triangles of all meshes."""
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    triangles = [mesh.triangles + o for mesh, o in zip(meshes, offsets, strict=True)]
    return np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles)


def spacing(grid, labels):
    """(m, n) metres from a beam's end to those of its neighbours in the grid on the same face, the farthest one."""
    out = np.zeros(labels.shape)
    for i, k in ((0, 1), (1, 0), (1, 1), (1, -1)):
        own = np.s_[: labels.shape[0] - i, max(0, -k) : labels.shape[1] - max(0, k)]
        other = np.s_[i:, max(0, k) : labels.shape[1] - max(0, -k)]
        step = np.linalg.norm(grid.points[other] - grid.points[own], axis=2)
        step = np.where((labels[own] == labels[other]) & (labels[own] >= 0) & np.isfinite(step), step, 0.0)
        # One after the other: the two overlap.
        out[own] = np.maximum(out[own], step)
        out[other] = np.maximum(out[other], step)
    return out


def far_samples(grid, labels, samples):
    """Which samples lie where no beam ends; the spacing is the widest of those of the nearest 12 points."""
    away, nearest = cKDTree(grid.points[grid.hit]).query(samples, 12)
    return away[:, 0] > 0.03 + spacing(grid, labels)[grid.hit][nearest].max(axis=1)


def beams_through(grid, vertices, triangles, sigma):
    """Share of the beams that pass through a mesh well before their end."""
    o3d = open3d_loader.load()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(vertices.astype(np.float32), triangles.astype(np.uint32))
    directions, ranges = grid.directions[grid.hit], grid.ranges[grid.hit]
    rays = np.column_stack([grid.points[grid.hit] - ranges[:, None] * directions, directions]).astype(np.float32)
    return np.mean(scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() < ranges - 0.03 - OUTLIER * sigma)


def measure(place, scans, kind="translation"):
    """Figures of one data set."""
    start = time.process_time()
    grid = make_grid(place.cloud, scans)
    faces = find_faces(grid)
    find_seconds = time.process_time() - start
    start = time.process_time()
    made = fit_set(place.cloud, scans, "set", grid, 0)
    seconds = time.process_time() - start
    of_faces = feet_of_faces(grid, faces.labels, [f.field for f in faces.fitted])
    feet = np.concatenate([found.points for found in of_faces])
    variance = np.concatenate([height_variance(f, of.uv) for f, of in zip(faces.fitted, of_faces, strict=True)])
    error = distance_to_mesh(feet, place.vertices, place.triangles)
    count = sum(s.control_points.size // 3 for s in made.surfaces)
    surface_map = SurfaceMap(tuple(made.surfaces), ())
    samples = surface_samples(surface_map, 0.05)
    stray = distance_to_mesh(samples, place.vertices, place.triangles) > 0.03
    meshes = [tessellate(surface, 0.001) for surface in made.surfaces]
    mesh = joined(meshes)
    missed = distance_to_mesh(place.clean[np.isin(place.cloud.scan_index, scans)], *mesh)
    rms = np.sqrt(np.mean(error**2))
    return Row(
        len(made.surfaces),
        count,
        len(feet) / grid.hit.sum(),
        faces.sigma,
        rms,
        rms / (faces.sigma * np.sqrt(count / len(feet))),
        error.max(),
        np.sqrt(np.mean(np.minimum(missed, CAP) ** 2)),
        1000 * stray.mean(),
        1000 * far_samples(grid, faces.labels, samples).mean(),
        1000 * beams_through(grid, *mesh, faces.sigma),
        np.mean(error**2 < CHI2_95 * variance),
        find_seconds,
        seconds,
    )


def show(name, rows):
    mean = Row(*np.mean(rows, axis=0))
    largest = max(row.largest for row in rows)
    print(
        f"{name:22} {len(rows):3d} {mean.faces:6.1f} {mean.control_points:7.1f} {100 * mean.share:8.2f}"
        f" {1e3 * mean.sigma:6.2f} {1e3 * mean.rms:7.3f} {mean.ratio:6.2f} {1e3 * largest:7.1f}"
        f" {1e3 * mean.all_beams:6.2f} {mean.stray:6.2f} {mean.far:6.2f} {mean.through:7.2f}"
        f" {100 * mean.inside:7.1f}"
        f" {mean.find_seconds:8.2f} {mean.seconds:7.2f}",
        flush=True,
    )


def simulated_rows(name, seeds):
    rows = {"translation": [], "rotation": []}
    for seed in range(seeds):
        place = simulated_place(name, seed)
        for movement in divide(place.cloud.scan_poses, 5.0):
            rows[movement.kind].append(measure(place, movement.scans, movement.kind))
    for kind, found in rows.items():
        if found:
            show(f"{name} {kind}", found)


def curved_rows(seeds):
    """Vaults that are neither plane nor vertical cylinder, passed along and turned in."""
    for mesh in (barrel_vault, tunnel, dome, egg, ring):
        places = [passing_set(mesh(), seed=seed) for seed in range(seeds)]
        show(f"{mesh.__name__} translation", [measure(place, np.arange(20)) for place in places])
        places = [turning_set(mesh(), np.array([1.0, 1.2, 0.3]), seed=seed) for seed in range(seeds)]
        show(f"{mesh.__name__} rotation", [measure(place, np.arange(19)) for place in places])


def real():
    cloud = real_room()
    points = in_faces = control_points = faces = 0
    residuals, far, through, seconds = [], [], [], 0.0
    for movement in divide(cloud.scan_poses, 5.0):
        start = time.process_time()
        grid = make_grid(cloud, movement.scans)
        found = find_faces(grid)
        surfaces = fit_set(cloud, movement.scans, "set", grid, 0).surfaces
        seconds += time.process_time() - start
        mask = (found.labels >= 0) & grid.hit
        points += int(grid.hit.sum())
        in_faces += int(mask.sum())
        control_points += sum(s.control_points.size // 3 for s in surfaces)
        residuals += [
            np.abs(feet.beyond) for feet in feet_of_faces(grid, found.labels, [f.field for f in found.fitted])
        ]
        spread = surface_samples(SurfaceMap(tuple(surfaces), ()), 0.05)
        far.append(far_samples(grid, found.labels, spread))
        faces += len(surfaces)
        mesh = joined([tessellate(surface, 0.001) for surface in surfaces])
        through.append(grid.hit.sum() * beams_through(grid, *mesh, found.sigma))
    print(
        f"\nreal room: {points} points, {100 * in_faces / points:.1f}% in {faces} faces,"
        f" {in_faces / control_points:.1f} points a control point, median residual"
        f" {1e3 * np.median(np.concatenate(residuals)):.2f} mm, far {1e3 * np.concatenate(far).mean():.2f},"
        f" through {1e3 * sum(through) / points:.2f}, {seconds:.1f} s"
    )


def main(seeds):
    print("data set               sets  faces  points in faces%  sigma     rms  ratio     max    all", end="  ")
    print("stray    far through inside%  find[s]  all[s]")
    for sigma in (0.002, 0.01, 0.03):
        places = [corridor_set(sigma, seed) for seed in range(seeds)]
        show(f"20 x 541, {1e3 * sigma:g} mm", [measure(place, np.arange(20)) for place in places])
    show("400 x 1081, 10 mm", [measure(corridor_set(scans=400, beams=1081), np.arange(400))])
    for scans, beams in ((10, 361), (40, 541), (200, 541)):
        places = [corridor_set(scans=scans, beams=beams, seed=seed) for seed in range(max(1, seeds // 3))]
        show(f"{scans} x {beams}, 10 mm", [measure(place, np.arange(scans)) for place in places])
    simulated_rows("room", max(1, seeds // 3))
    simulated_rows("corridor", max(1, seeds // 5))
    simulated_rows("loop", max(1, seeds // 3))
    curved_rows(max(1, seeds // 3))
    real()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
