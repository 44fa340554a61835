"""What joining faces does to maps of known truth: simulate, slam, cloud, fit --method faces, merge.

    python tests/bench_merge_faces.py [seeds [scene ...]]

One row before and one after merging. area: square metres of all faces; seen: of the true scene with a beam's end
within 8 cm; shown: of it inside the cells between four neighbouring beams that end on one flat face (a map also fills
what cells at corners hold of two faces); doubled: area that another face covers, too, within 3 cm and about parallel.
mean, 95%, max: millimetres of samples of the map to the true scene, laid over it by the first pose and by the whole
trajectory. hit: share of the beams' true ends within 2 cm of the map.
bytes: of the map as .json.gz over 12 bytes a point of the cloud.

Creases of the merged map: T: corners in which the border of a face goes straight on. sides: of all creases. open:
those along which the borders of the two faces' meshes are not the same vertices to the last bit. gap: largest distance
between the two borders. edges: of the true scene, samples with ends of beams within 8 cm on both sides; share within
2 cm of a crease, or of a crease or a rim, and median distance to both, of the map laid over the scene by the
trajectory. Before: the creases of all data sets.
"""

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scenes import simulated, true_slam_map
from scipy.spatial import cKDTree
from shared_creases import seams
from true_edges import distance_to_lines, seen_edges

from bsmap_cli import open3d_loader
from bsmap_cli.cloud import make_cloud
from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.trims import rims_of
from bsmap_cli.evaluate import align, distance_to_mesh, surface_samples, transform_points
from bsmap_cli.export.tessellation import tessellate_map
from bsmap_cli.fit import divide, fit_surfaces
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.io.surfaces_json import write_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.params import CloudParams, FitParams, MergeParams, SlamParams
from bsmap_cli.slam import run_slam

DENSITY = 400.0
"""Samples a square metre for areas."""


def samples_of(vertices, triangles, seed=0):
    """Even samples (n, 3), unit normals (n, 3) and the area of a mesh."""
    a, b, c = np.moveaxis(vertices[triangles], 1, 0)
    cross = np.cross(b - a, c - a)
    areas = np.linalg.norm(cross, axis=1) / 2
    rng = np.random.default_rng(seed)
    n = int(areas.sum() * DENSITY)
    if n == 0:
        return np.zeros((0, 3)), np.zeros((0, 3)), areas.sum()
    k = rng.choice(len(areas), n, p=areas / areas.sum())
    u, v = np.sqrt(rng.random(n))[:, None], rng.random(n)[:, None]
    return (1 - u) * a[k] + u * (1 - v) * b[k] + u * v * c[k], cross[k] / (2 * areas[k, None]), areas.sum()


def areas(meshes):
    """Area of all, and what of it lies doubled: the whole less each place once."""
    o3d = open3d_loader.load()
    scenes = []
    for mesh in meshes:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(mesh.vertices.astype(np.float32), mesh.triangles.astype(np.uint32))
        scenes.append(scene)
    low, high = (np.array([f(mesh.vertices, axis=0) for mesh in meshes]) for f in (np.min, np.max))
    total = single = 0.0
    for i, mesh in enumerate(meshes):
        points, normals, area = samples_of(mesh.vertices, mesh.triangles)
        layers = np.ones(len(points))
        for j in np.flatnonzero(np.all((low < high[i] + 0.03) & (high > low[i] - 0.03), axis=1)):
            if j != i:
                found = scenes[j].compute_closest_points(o3d.core.Tensor(points.astype(np.float32)))
                way = found["points"].numpy() - points
                other = found["primitive_normals"].numpy()
                across = np.abs(np.sum(way * normals, axis=1))
                along = np.sqrt(np.maximum(np.sum(way**2, axis=1) - across**2, 0.0))
                # Inside the other face its foot lies along its normal; beside its border, at a smooth seam, not.
                parallel = np.abs(np.sum(other * normals, axis=1)) > 0.9
                layers += (across < 0.03) & (along < 0.5 * across + 1e-4) & parallel
        total += area
        single += area * np.mean(1.0 / layers) if len(points) else area
    return total, total - single


def seen_area(simulation, ends):
    points, _, area = samples_of(simulation.vertices, simulation.triangles)
    return area * np.mean(cKDTree(ends).query(points, distance_upper_bound=0.08)[0] < 0.08)


def shown_area(simulation, clean, start):
    """Area of the true scene inside the cells of four neighbouring beams whose true ends lie on one flat face.

    Scans of a rotation lie 40 cm apart in the distance: the map fills such cells, though no beam ends within 8 cm.
    clean : cloud without noise at true poses.  start : (3,) pose of its map in the scene.
    """
    vertices, triangles, count = [], [], 0
    for movement in divide(clean.scan_poses, FitParams().set_length):
        ends = make_grid(clean, movement.scans).points
        corners = np.stack([ends[:-1, :-1], ends[:-1, 1:], ends[1:, 1:], ends[1:, :-1]])
        cells = np.argwhere(np.all(np.isfinite(corners), axis=(0, 3)))
        quads = corners[:, cells[:, 0], cells[:, 1]]
        between = np.concatenate([(quads + np.roll(quads, -1, axis=0)) / 2, quads.mean(axis=0)[None]])
        off = distance_to_mesh(
            transform_points(start, between.reshape(-1, 3)), simulation.vertices, simulation.triangles
        )
        quads = quads[:, off.reshape(5, -1).max(axis=0) < 0.005]
        number = count + np.arange(4 * quads.shape[1]).reshape(4, -1)
        vertices.append(transform_points(start, quads.reshape(-1, 3)))
        triangles += [number[[0, 1, 2]].T, number[[0, 2, 3]].T]
        count += number.size
    points, _, area = samples_of(simulation.vertices, simulation.triangles)
    near = distance_to_mesh(points, np.concatenate(vertices), np.concatenate(triangles)) < 0.01
    return area * np.mean(near)


def bytes_of(surface_map):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "map.json.gz"
        write_surfaces(path, surface_map)
        return path.stat().st_size


def row(name, surface_map, simulation, cloud, poses, ends):
    samples = surface_samples(surface_map, 0.05)
    figures = []
    for pose in poses:
        d = 1e3 * distance_to_mesh(transform_points(pose, samples), simulation.vertices, simulation.triangles)
        figures.append(f"{d.mean():6.2f} {np.quantile(d, 0.95):6.2f} {d.max():5.0f}")
    meshes = tessellate_map(surface_map, 0.002)
    total, doubled = areas(meshes)
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    vertices = transform_points(poses[-1], np.concatenate([mesh.vertices for mesh in meshes]))
    triangles = np.concatenate([mesh.triangles + o for mesh, o in zip(meshes, offsets, strict=True)])
    some = ends[:: max(1, len(ends) // 100_000)]
    hit = np.mean(distance_to_mesh(some, vertices, triangles) < 0.02)
    controls = sum(s.control_points.shape[0] * s.control_points.shape[1] for s in surface_map.surfaces)
    share = bytes_of(surface_map) / (12 * len(cloud.points))
    print(
        f"{name:24} {len(surface_map.surfaces):5d} {controls:6d} {total:8.1f} {doubled:7.2f} {'  '.join(figures)}"
        f" {hit:7.2%} {share:7.3%}",
        flush=True,
    )


def free_ends(surface_map):
    return sum(corner < 0 for crease in surface_map.creases for corner in crease.corners)


def straight_corners(surface_map):
    """Corners in which the border of a face goes on within ten degrees."""
    found = set()
    for surface in surface_map.surfaces:
        for loop in surface.trims:
            at = evaluate_surface(surface, *loop.parameters.T)
            ways = np.roll(at, -1, axis=0) - at
            ways /= np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
            turn = np.sum(ways * np.roll(ways, 1, axis=0), axis=1)
            both = (loop.creases >= 0) & (np.roll(loop.creases, 1) >= 0) & (loop.creases != np.roll(loop.creases, 1))
            for k in np.flatnonzero(both & (turn > np.cos(np.radians(10.0)))):
                pair = [surface_map.creases[c].corners for c in (loop.creases[k - 1], loop.creases[k])]
                found |= {corner for corner in pair[0] if corner >= 0 and corner in pair[1]}
    return len(found)


def seam_figures(surface_map):
    meshes = dict(zip([s.name for s in surface_map.surfaces], tessellate_map(surface_map, 0.002), strict=True))
    found = seams(surface_map.creases, meshes)
    return f"sides {found.sides}, open {found.open}, gap {1e3 * found.gap:g} mm"


def edge_figures(surface_map, samples, pose):
    lines = [crease.points for crease in surface_map.creases]
    rims = [rim.points for surface in surface_map.surfaces for rim in rims_of(surface)]
    creases, both = (
        distance_to_lines(samples, [transform_points(pose, line) for line in some]) for some in (lines, lines + rims)
    )
    near = f"edges {np.mean(creases < 0.02):.2%}, with rims {np.mean(both < 0.02):.2%}"
    return f"{near}, median {1e3 * np.median(both):.2f} mm"


def true_cloud(scene, seed):
    """Cloud without noise at true poses."""
    return make_cloud(true_slam_map(simulated(scene, seed=seed, range_sigma=0.0)), CloudParams())


def bench(scene, seed, true_poses):
    simulation = simulated(scene, seed=seed)
    truth = simulation.truth
    slam_map = true_slam_map(simulation) if true_poses else run_slam(simulation.log, SlamParams())
    cloud = make_cloud(slam_map, CloudParams())
    fitted = fit_surfaces(cloud, FitParams(method="faces"))
    start = time.perf_counter()
    merged = merge_surfaces([fitted], MergeParams())
    seconds = time.perf_counter() - start
    first = truth.poses[np.searchsorted(truth.time_ns, simulation.log.horizontal.time_ns[0])]
    poses = [first, align(slam_map.trajectory, truth).pose]
    clean = true_cloud(scene, seed)
    ends = transform_points(first, clean.points)
    name = f"{scene} {seed} {'true poses' if true_poses else 'slam'}"
    row(name, fitted, simulation, cloud, poses, ends)
    row("  merged", merged, simulation, cloud, poses, ends)
    reasons = Counter(d.outcome if d.outcome == "merged" else d.reason.split(" and ")[0] for d in merged.decisions)
    edges = seen_edges(simulation.vertices, simulation.triangles, ends)
    print(
        f"  creases {len(fitted.creases)} -> {len(merged.creases)}, corners {len(merged.corners)}"
        f" ({straight_corners(merged)} T), free ends {free_ends(merged)}, {seam_figures(merged)};"
        f" before: {edge_figures(fitted, edges, poses[-1])}; after: {edge_figures(merged, edges, poses[-1])}"
    )
    seen, shown = seen_area(simulation, ends), shown_area(simulation, clean, first)
    print(f"  {seconds:.2f} s; seen {seen:.1f} m2, shown {shown:.1f} m2; {dict(reasons)}; {merged.notes}", flush=True)


def main(seeds=2, *scenes):
    print(
        f"{'':24} {'faces':>5} {'points':>6} {'area':>8} {'doubled':>7}"
        f" {'mean':>6} {'95%':>6} {'max':>5}  {'mean':>6} {'95%':>6} {'max':>5} {'hit':>7} {'bytes':>7}"
    )
    for scene in scenes or ("room", "corridor", "loop"):
        for seed in range(int(seeds)):
            for true_poses in (True, False):
                bench(scene, seed, true_poses)


if __name__ == "__main__":
    main(*sys.argv[1:])
