"""Surveys of one room folded into one map, one after the other: bytes, error, covariance, decisions, time.

    python tests/bench_surveys.py [surveys [scene]]

bytes: of the map as .map.json.gz. mean, 95%, max: millimetres of samples of the map to the true scene, the map itself
laid over it. sigma: root mean square standard deviation across the faces, millimetres, sensor and pose part. nees: mean
normalised squared error across the faces (1 where the covariance is true, and all of it, frame included, is known);
in: share of samples inside 95%. Poses are the true ones, then those of our slam; each survey's map lies in the frame of
its first pose, which is the same place in every log.
"""

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scenes import simulated, true_slam_map

from bsmap_cli import open3d_loader
from bsmap_cli.cloud import make_cloud
from bsmap_cli.core.uncertainty import pose_covariance
from bsmap_cli.evaluate import distance_to_mesh, surface_samples, transform_points
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.bases import based_face, has_base, normals
from bsmap_cli.params import CloudParams, FitParams, MergeParams, SlamParams
from bsmap_cli.slam import run_slam


def laid_over(samples, simulation, pose):
    """Pose (3,) of the map in the scene for which samples lie nearest to the scene's surfaces, from a first guess."""
    o3d = open3d_loader.load()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(simulation.vertices.astype(np.float32), simulation.triangles.astype(np.uint32))
    for _ in range(10):
        points = transform_points(pose, samples)
        found = scene.compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
        normals = found["primitive_normals"].numpy()
        off = np.sum((found["points"].numpy() - points) * normals, axis=1)
        x, y = (points[:, :2] - pose[:2]).T
        J = np.column_stack([normals[:, 0], normals[:, 1], normals[:, 1] * x - normals[:, 0] * y])
        near = np.abs(off) < 0.02
        pose = pose + np.linalg.lstsq(J[near], off[near], rcond=None)[0]
    return pose


def calibration(surface_map, simulation, pose):
    """Errors and variances, sensor and pose part, of samples on all faces over a base."""
    errors, sensor, poses = [], [], []
    for surface in surface_map.surfaces:
        face = based_face(surface) if has_base(surface) else None
        if face is not None:
            points = face.samples[face.areas > 0]
            d = distance_to_mesh(transform_points(pose, points), simulation.vertices, simulation.triangles)
            n = normals(face.field.base, points)
            own = np.einsum("ni,nij,nj->n", n, pose_covariance(surface.covariance.pose, points), n)
            near = d < 0.03
            errors.append(d[near])
            sensor.append(face.variances[face.areas > 0][near])
            poses.append(own[near])
    return np.concatenate(errors), np.concatenate(sensor), np.concatenate(poses)


def fitted(scene, seed, true_poses):
    simulation = simulated(scene, seed=seed)
    slam_map = true_slam_map(simulation) if true_poses else run_slam(simulation.log, SlamParams())
    return fit_surfaces(make_cloud(slam_map, CloudParams()), FitParams(method="faces"))


def row(number, survey, merged, simulation, first, path, seconds):
    samples = surface_samples(merged, 0.05)
    pose = laid_over(samples, simulation, first)
    d = 1e3 * distance_to_mesh(transform_points(pose, samples), simulation.vertices, simulation.triangles)
    error, sensor, poses = calibration(merged, simulation, pose)
    ratio = error**2 / (sensor + poses)
    counts = Counter("moved" if "moved" in x.reason else x.outcome for x in merged.decisions)
    print(
        f"{number:7d} {len(survey.surfaces):6d} {len(merged.surfaces):6d} {len(merged.data_sets):5d}"
        f" {path.stat().st_size:7d} {d.mean():6.3f} {np.quantile(d, 0.95):5.2f} {d.max():4.0f}"
        f" {1e3 * np.sqrt(sensor.mean()):6.2f} {1e3 * np.sqrt(poses.mean()):5.2f} {ratio.mean():6.2f}"
        f" {np.mean(ratio < 3.84):6.1%} {seconds:6.2f}  {dict(counts)}",
        flush=True,
    )


def main(surveys=10, scene="room"):
    for true_poses in (True, False):
        print(f"{scene}, {'true poses' if true_poses else 'poses of our slam'}")
        print(
            f"{'surveys':>7} {'faces':>6} {'of map':>6} {'sets':>5} {'bytes':>7} {'mean':>6} {'95%':>5} {'max':>4}"
            f" {'sensor':>6} {'pose':>5} {'nees':>6} {'in':>6} {'s':>6}"
        )
        merged = None
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "a.map.json.gz"
            for seed in range(int(surveys)):
                survey = fitted(scene, seed, true_poses)
                start = time.process_time()
                merged = merge_surfaces([survey] if merged is None else [merged, survey], MergeParams())
                seconds = time.process_time() - start
                write_surfaces(path, merged)
                merged = read_surfaces(path)
                simulation = simulated(scene, seed=seed)
                at = np.searchsorted(simulation.truth.time_ns, simulation.log.horizontal.time_ns[0])
                row(seed + 1, survey, merged, simulation, simulation.truth.poses[at], path, seconds)
                simulated.cache_clear()


if __name__ == "__main__":
    main(*sys.argv[1:])
