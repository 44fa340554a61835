"""Faces of data sets of known truth, and of a real room: what `bsmap fit --method faces` reaches.

    python tests/bench_faces.py [seeds]

rms, max: millimetres from the faces at the feet of their beams to the true scene.
ratio: rms over the statistical limit sigma * sqrt(control points / beams).
all: rms from the true points of all beams to the trimmed surfaces, capped at 0.1 m.
stray: samples of the surfaces farther than 3 cm from the truth, per thousand.
inside: per cent of the feet whose error the 95% interval of the sensor part holds.
Means over seeds; max is the largest.
"""

import sys
import time
from typing import NamedTuple

import numpy as np
from face_scenes import corridor_set, real_room, simulated_place

from bsmap_cli.evaluate import distance_to_mesh, surface_samples
from bsmap_cli.export.tessellation import tessellate
from bsmap_cli.fit import divide
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.faces import fit_set
from bsmap_cli.fit.heights import basis_matrix, evaluate
from bsmap_cli.fit.labels import feet_of
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
    inside: float
    find_seconds: float
    seconds: float


def height_variance(fitted, uv):
    """Variance (n,) across the surface at parameters (n, 2)."""
    N = basis_matrix(fitted.field.knots, uv)
    tilt = 1.0 + np.sum(evaluate(fitted.field, uv)[1] ** 2, axis=1)
    return np.sum((N @ np.linalg.inv(fitted.information)) * N, axis=1) / tilt


def measure(place, scans, kind="translation"):
    """Figures of one data set."""
    start = time.process_time()
    grid = make_grid(place.cloud, scans)
    faces = find_faces(grid)
    find_seconds = time.process_time() - start
    start = time.process_time()
    made = fit_set(place.cloud, scans, "set", grid, 0)
    seconds = time.process_time() - start
    of_faces = [feet_of(grid, f.field, (faces.labels == k) & grid.hit) for k, f in enumerate(faces.fitted)]
    feet = np.concatenate([found.points for found in of_faces])
    variance = np.concatenate([height_variance(f, of.uv) for f, of in zip(faces.fitted, of_faces, strict=True)])
    error = distance_to_mesh(feet, place.vertices, place.triangles)
    count = sum(s.control_points.size // 3 for s in made.surfaces)
    surface_map = SurfaceMap(tuple(made.surfaces), ())
    samples = surface_samples(surface_map, 0.05)
    stray = distance_to_mesh(samples, place.vertices, place.triangles) > 0.03
    meshes = [tessellate(surface, 0.001) for surface in made.surfaces]
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    clean = place.clean[np.isin(place.cloud.scan_index, scans)]
    missed = distance_to_mesh(
        clean,
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.triangles + o for mesh, o in zip(meshes, offsets, strict=True)]),
    )
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
        f" {1e3 * mean.all_beams:6.2f} {mean.stray:6.2f} {100 * mean.inside:7.1f}"
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


def real():
    cloud = real_room()
    start = time.process_time()
    points = in_faces = control_points = faces = 0
    residuals = []
    for movement in divide(cloud.scan_poses, 5.0):
        grid = make_grid(cloud, movement.scans)
        found = find_faces(grid)
        points += int(grid.hit.sum())
        faces += len(found.fitted)
        for k, fitted in enumerate(found.fitted):
            mask = (found.labels == k) & grid.hit
            in_faces += int(mask.sum())
            control_points += fitted.field.knots.size
            residuals.append(np.abs(feet_of(grid, fitted.field, mask).beyond))
    median = 1e3 * np.median(np.concatenate(residuals))
    print(
        f"\nreal room: {points} points, {100 * in_faces / points:.1f}% in {faces} faces,"
        f" {in_faces / control_points:.1f} points a control point, median residual {median:.2f} mm,"
        f" {time.process_time() - start:.1f} s"
    )


def main(seeds):
    print("data set               sets  faces  points in faces%  sigma     rms  ratio     max    all", end="  ")
    print("stray inside%  find[s]  all[s]")
    for sigma in (0.002, 0.01, 0.03):
        places = [corridor_set(sigma, seed) for seed in range(seeds)]
        show(f"20 x 541, {1e3 * sigma:g} mm", [measure(place, np.arange(20)) for place in places])
    show("400 x 1081, 10 mm", [measure(corridor_set(scans=400, beams=1081), np.arange(400))])
    simulated_rows("room", max(1, seeds // 3))
    simulated_rows("corridor", max(1, seeds // 5))
    real()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 10)
