"""Whether a map's covariance tells its errors, after fusion, over seeds.

    python tests/bench_calibration.py [seeds [scene ...]]

Of samples on all faces the error across the face to the true scene, over the variance that the map tells there, sensor
and pose part. nees: mean of the squared ratio (1 is right); in: share inside the 95% interval. Samples that lie on no
wall of their direction in the scene do not count. First the map as it lies, the first pose being known; then the map
laid over the scene by least squares, and what that takes away of its errors taken away from its covariance, too.
error, sensor, pose: root mean squares, millimetres; the last two are what the map tells. Last of all the faces that
weigh most in the first nees.
"""

import sys
from typing import NamedTuple

import numpy as np
from scenes import simulated, true_slam_map

from bsmap_cli import open3d_loader
from bsmap_cli.cloud import make_cloud
from bsmap_cli.core.bspline import design_matrix, evaluate_surface
from bsmap_cli.core.trims import inside_trims
from bsmap_cli.evaluate import transform_points
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.information import unit_errors
from bsmap_cli.params import CloudParams, FitParams, MergeParams, SlamParams
from bsmap_cli.slam import run_slam

STEP = 0.1
"""Metres between samples of a face."""
INSIDE = 1.96
"""Standard deviations between which 95% of normal errors lie."""
FAR = 0.05
"""Metres from the scene beyond which a sample lies on nothing that is there."""


class Sampled(NamedTuple):
    """Samples of all faces: error (n,) metres across them, and how it depends on errors of unit variance.

    face : (n,) number of the face.  by_pose : (n, p).  by_sensor : of each face (of its samples, heights).
    across : (n, 3) change of the error by a shift in x and y of the map and a turn about its origin.
    """

    error: np.ndarray
    face: np.ndarray
    by_pose: np.ndarray
    by_sensor: list[np.ndarray]
    across: np.ndarray


def sampled(surface_map, simulation, pose):
    """Samples of a map of height fields, laid over the scene by a pose (3,)."""
    columns = _columns(surface_map)
    parts, by_sensor = [], []
    for number, surface in enumerate(surface_map.surfaces):
        uv, points, normals = _grid(surface)
        error, good = _errors(points, normals, simulation, pose)
        uv, points, normals = uv[good], points[good], normals[good]
        lever = normals[:, 1] * points[:, 0] - normals[:, 0] * points[:, 1]
        across = np.column_stack([normals[:, :2], lever])
        by_pose = np.zeros((good.sum(), 1 + max((max(c) for c in columns.values()), default=-1)))
        for part in surface.covariance.pose:
            x, y = part.centre
            J = np.column_stack([normals[:, :2], lever - normals[:, 1] * x + normals[:, 0] * y])
            by_pose[:, columns[part.data_set]] += part.weight * J @ unit_errors(part)
        by_sensor.append(_by_heights(surface, uv, normals) @ _root(surface.covariance.matrix))
        parts.append((error[good], np.full(good.sum(), number), by_pose, across))
    error, face, by_pose, across = (np.concatenate(some) for some in zip(*parts, strict=True))
    return Sampled(error, face, by_pose, by_sensor, across)


def _columns(surface_map):
    """Numbers of each data set's errors of unit variance; those of a trajectory's modes are shared."""
    out, modes, size = {}, {}, 0
    for part in {p.data_set: p for s in surface_map.surfaces for p in s.covariance.pose}.values():
        out[part.data_set], size = list(range(size, size + 3)), size + 3
        if part.modes is not None:
            if part.trajectory not in modes:
                modes[part.trajectory] = list(range(size, size + part.modes.shape[1]))
                size += part.modes.shape[1]
            out[part.data_set] += modes[part.trajectory]
    return out


def _grid(surface):
    P = surface.control_points
    lengths = [np.linalg.norm(np.diff(P, axis=k), axis=2).sum(axis=k).max() for k in (0, 1)]
    u, v = ((np.arange(n) + 0.5) / n for n in (max(1, int(np.ceil(length / STEP))) for length in lengths))
    uv = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    uv = uv[inside_trims(surface, uv)]
    points, Su, Sv = evaluate_surface(surface, uv[:, 0], uv[:, 1], 1)
    normals = np.cross(Su, Sv)
    return uv, points, normals / np.linalg.norm(normals, axis=1)[:, None]


def _errors(points, normals, simulation, pose):
    """Errors (n,) across the faces, and which of the samples lie on a plane of the scene."""
    if not len(points):
        return np.zeros(0), np.zeros(0, dtype=bool)
    o3d = open3d_loader.load()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(simulation.vertices.astype(np.float32), simulation.triangles.astype(np.uint32))
    there = transform_points(pose, points)
    turned = transform_points(np.array([0.0, 0.0, pose[2]]), normals)
    found = scene.compute_closest_points(o3d.core.Tensor(there.astype(np.float32)))
    a, b, c = np.moveaxis(simulation.vertices[simulation.triangles[found["primitive_ids"].numpy()]], 1, 0)
    n = np.cross(b - a, c - a)
    n /= np.linalg.norm(n, axis=1)[:, None]
    cosine = np.sum(n * turned, axis=1)
    off = np.sum((there - a) * n, axis=1)
    aside = np.linalg.norm(found["points"].numpy() - there + off[:, None] * n, axis=1)
    good = (np.abs(cosine) > 0.95) & (np.abs(off) < FAR) & (aside < 0.005)
    return off * np.sign(cosine), good


def _by_heights(surface, uv, normals):
    """(n, k) change across the face by each control height."""
    along = [
        design_matrix(knots, degree, uv[:, k])
        for k, (knots, degree) in enumerate(((surface.knots_u, surface.degree_u), (surface.knots_v, surface.degree_v)))
    ]
    directions = np.broadcast_to(surface.covariance.directions, surface.control_points.shape)
    return np.einsum("ni,nj,ijk,nk->nij", *along, directions, normals, optimize=True).reshape(len(uv), -1)


def _root(matrix):
    values, vectors = np.linalg.eigh(matrix)
    return vectors * np.sqrt(np.maximum(values, 0.0))


def aligned(samples):
    """The samples with what a shift and a turn of the map could explain taken away from errors and covariance."""
    J = samples.across
    Q = np.linalg.qr(J)[0]
    taken = Q @ (Q.T @ samples.error)
    by_pose = samples.by_pose - Q @ (Q.T @ samples.by_pose)
    variances = np.zeros(len(samples.error))
    for number, G in enumerate(samples.by_sensor):
        own = samples.face == number
        through = Q @ (Q[own].T @ G)
        through[own] -= G
        variances += np.sum(through**2, axis=1)
    return samples.error - taken, np.sum(by_pose**2, axis=1), variances


def plain(samples):
    """Errors, and variances of pose and sensor part, (n,) each."""
    sensor = np.concatenate([np.sum(G**2, axis=1) for G in samples.by_sensor])
    return samples.error, np.sum(samples.by_pose**2, axis=1), sensor


def figures(error, pose, sensor):
    """rms error, sensor, pose in millimetres, nees, share inside."""
    ratio = error**2 / np.maximum(pose + sensor, 1e-18)
    rms = [1e3 * np.sqrt(np.mean(x)) for x in (error**2, sensor, pose)]
    return np.array([*rms, np.mean(ratio), np.mean(ratio < INSIDE**2)])


def worst(surface_map, samples, count=3):
    """Names of the faces whose errors weigh most in nees, and how much."""
    error, pose, sensor = plain(samples)
    ratio = error**2 / np.maximum(pose + sensor, 1e-18)
    sums = np.bincount(samples.face, ratio, len(surface_map.surfaces)) / max(len(ratio), 1)
    order = np.argsort(-sums)[:count]
    return ", ".join(f"{surface_map.surfaces[k].name} {sums[k]:.2f}" for k in order)


def merged_map(scene, seed, true_poses):
    """The map of a simulated log with default options."""
    simulation = simulated(scene, seed=seed)
    slam_map = true_slam_map(simulation) if true_poses else run_slam(simulation.log, SlamParams())
    fitted = fit_surfaces(make_cloud(slam_map, CloudParams()), FitParams())
    return merge_surfaces([fitted], MergeParams()), simulation


def bench(scene, seeds, true_poses, made=merged_map):
    """Print a row a seed, and the mean of all."""
    rows = []
    for seed in range(seeds):
        surface_map, simulation = made(scene, seed, true_poses)
        at = np.searchsorted(simulation.truth.time_ns, simulation.log.horizontal.time_ns[0])
        samples = sampled(surface_map, simulation, simulation.truth.poses[at])
        rows.append([figures(*plain(samples)), figures(*aligned(samples))])
        _print(f"{scene} {seed} {'true poses' if true_poses else 'slam'}", rows[-1], worst(surface_map, samples))
        simulated.cache_clear()
    _print(f"{scene} {'true poses' if true_poses else 'slam'}, {seeds} seeds", np.mean(rows, axis=0), "")


def _print(name, row, last):
    text = "   ".join(f"{e:7.3f} {s:7.3f} {p:7.3f} {n:7.2f} {i:7.1%}" for e, s, p, n, i in row)
    print(f"{name:26} {text}   {last}", flush=True)


def main(seeds=20, *scenes):
    head = f"{'error':>7} {'sensor':>7} {'pose':>7} {'nees':>7} {'in':>7}"
    print(f"{'':26} {head}   {head}  (map aligned)")
    for scene in scenes or ("room", "corridor"):
        for true_poses in (True, False):
            bench(scene, int(seeds), true_poses)


if __name__ == "__main__":
    main(*sys.argv[1:])
