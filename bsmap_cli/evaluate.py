"""Errors against known truth: trajectories after alignment, points and surfaces against the scene's mesh."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli import open3d_loader
from bsmap_cli.core import se2
from bsmap_cli.core.bspline import Surface, evaluate_grid, evaluate_surface
from bsmap_cli.core.trims import inside_trims
from bsmap_cli.errors import BsmapError
from bsmap_cli.model import Array, BSplineSurface, IntArray, PointCloud, Residuals, SurfaceMap, Trajectory

POINTS_AT_ONCE = 500_000
COARSE_SAMPLES = 33  # a direction, to measure how long a surface is


class Alignment(NamedTuple):
    """How one trajectory is laid over another, and what error is left.

    pose : (3,) of the estimate's frame (map) in the truth's frame (scene).  pairs : of poses compared.
    rms, maximum : m, of positions.  heading_rms : rad.
    """

    pose: Array
    pairs: int
    rms: float
    maximum: float
    heading_rms: float


def align(estimate: Trajectory, truth: Trajectory) -> Alignment:
    """Lay the estimate over the truth, interpolated to the estimate's times, by the best turn and shift of all.

    Umeyama (1991) in the plane, without scale. Poses at times that the truth does not cover are left out.
    Raises BsmapError where the two share less than two times.
    """
    shared = (estimate.time_ns >= truth.time_ns[0]) & (estimate.time_ns <= truth.time_ns[-1])
    if np.count_nonzero(shared) < 2:
        raise BsmapError(
            f"{np.count_nonzero(shared)} of {len(shared)} poses lie in the time of the truth; 2 are needed"
        )
    poses = estimate.poses[shared]
    wanted = se2.interpolate(truth.time_ns, truth.poses, estimate.time_ns[shared])
    pose = fit_pose(poses[:, :2], wanted[:, :2])
    error = se2.between(wanted, se2.compose(pose, poses))
    distance = np.hypot(error[:, 0], error[:, 1])
    heading_rms = float(np.sqrt(np.mean(error[:, 2] ** 2)))
    return Alignment(pose, len(poses), float(np.sqrt(np.mean(distance**2))), float(distance.max()), heading_rms)


def fit_pose(source: Array, target: Array) -> Array:
    """Pose (3,) whose transform brings points `source` (n, 2) nearest to `target` (n, 2) in least squares."""
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    theta = np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b))
    turn = np.array([0.0, 0.0, theta])
    return np.array([*(target_mean - se2.transform(turn, source_mean)), theta])


def transform_points(pose: Array, points: Array) -> Array:
    """Points (n, 3) in the frame in which the planar pose (3,) is given, from the frame at the pose; z is kept."""
    return np.column_stack([se2.transform(pose, points[:, :2]), points[:, 2]])


def distance_to_mesh(points: Array, vertices: Array, triangles: IntArray) -> Array:
    """Distances (n,) m, without sign, of points (n, 3) to the nearest triangle of a mesh in the same frame.

    vertices : (k, 3) m.  triangles : (m, 3). Open3D finds the triangle, in float32; its distances are off by
    millimetres at long thin triangles, so the distance to the triangle is computed here in float64.
    """
    o3d = open3d_loader.load()
    centre = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    corners = (vertices - centre)[triangles]
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles((vertices - centre).astype(np.float32), triangles.astype(np.uint32))
    out = np.empty(len(points))
    for first in range(0, len(points), POINTS_AT_ONCE):
        part = slice(first, first + POINTS_AT_ONCE)
        query = points[part] - centre
        nearest = scene.compute_closest_points(o3d.core.Tensor(query.astype(np.float32)))["primitive_ids"].numpy()
        out[part] = _distance_to_triangles(query, corners[nearest])
    return out


def _distance_to_triangles(points: Array, corners: Array) -> Array:
    """Distances (n,) of points (n, 3), each to its own triangle (n, 3, 3)."""
    sides = np.roll(corners, -1, axis=1) - corners
    to_point = points[:, None] - corners
    normal = np.cross(sides[:, 0], sides[:, 1])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    above = np.all(np.einsum("nij,nij->ni", np.cross(normal[:, None], sides), to_point) >= 0, axis=1)
    along = np.einsum("nij,nij->ni", to_point, sides) / np.einsum("nij,nij->ni", sides, sides)
    off_sides = np.linalg.norm(to_point - np.clip(along, 0, 1)[..., None] * sides, axis=2).min(axis=1)
    return np.where(above, np.abs(np.einsum("ni,ni->n", normal, to_point[:, 0])), off_sides)


def summary(distances: Array) -> Residuals:
    """Mean, RMS, 95th percentile and largest of distances (n,)."""
    if len(distances) == 0:
        return Residuals(0, 0.0, 0.0, 0.0, 0.0)
    rms = np.sqrt(np.mean(np.square(distances)))
    percentile = np.percentile(distances, 95)
    return Residuals(len(distances), *(float(f) for f in (distances.mean(), rms, percentile, distances.max())))


def surface_samples(surface_map: SurfaceMap, step: float) -> Array:
    """Points (n, 3) on all surfaces of a map, about `step` metres apart, edges and corners included.

    Of a trimmed surface those inside its trims, and the corners of its loops.
    """
    samples = [_samples_of(surface, step) for surface in surface_map.surfaces]
    return np.concatenate([np.empty((0, 3)), *samples])


def _samples_of(surface: Surface, step: float) -> Array:
    coarse = np.linspace(0.0, 1.0, COARSE_SAMPLES)
    grid = evaluate_grid(surface, coarse, coarse)
    u, v = (_even_parameters(coarse, lines, step) for lines in (grid, grid.swapaxes(0, 1)))
    if not (isinstance(surface, BSplineSurface) and surface.trims):
        return evaluate_grid(surface, u, v).reshape(-1, 3)
    parameters = np.stack(np.meshgrid(u, v, indexing="ij"), axis=-1).reshape(-1, 2)
    corners = [loop.parameters for loop in surface.trims]
    parameters = np.concatenate([parameters[inside_trims(surface, parameters)], *corners])
    return evaluate_surface(surface, *parameters.T)


def _even_parameters(coarse: Array, lines: Array, step: float) -> Array:
    """Parameters at even steps of the mean length along lines (k, n, 3), which are given at parameters coarse (k,)."""
    lengths = np.linalg.norm(np.diff(lines, axis=0), axis=2)
    way = np.concatenate([[0.0], np.cumsum(lengths.mean(axis=1))])
    count = max(2, int(np.ceil(lengths.sum(axis=0).max() / step)) + 1)
    # A surface shrunk to a point has no length to divide evenly.
    return np.interp(np.linspace(0.0, way[-1], count), way, coarse) if way[-1] > 0 else coarse[[0, -1]]


class Mesh(NamedTuple):
    """Scene of known shape. vertices : (n, 3), metres.  triangles : (m, 3)."""

    vertices: Array
    triangles: IntArray


def evaluate_run(
    trajectory: Trajectory,
    cloud: PointCloud,
    maps: Sequence[SurfaceMap],
    truth: Trajectory,
    scene: Mesh,
    step: float,
) -> dict[str, float]:
    """Errors of trajectory, cloud, surfaces and merged map (`maps`: both), laid over the scene by the trajectory.

    Surfaces are sampled about every `step` metres. Keys are the rows' names in the report.
    """
    aligned = align(trajectory, truth)
    rows: dict[str, float] = {
        "trajectory RMS [m]": aligned.rms,
        "trajectory max [m]": aligned.maximum,
        "heading RMS [deg]": float(np.degrees(aligned.heading_rms)),
        "cloud points": len(cloud.points),
    }
    samples = {"cloud": cloud.points} | {
        name: surface_samples(one, step) for name, one in zip(("surfaces", "map"), maps, strict=True)
    }
    for name, points in samples.items():
        error = summary(distance_to_mesh(transform_points(aligned.pose, points), scene.vertices, scene.triangles))
        rows |= {
            f"{name} mean [m]": error.mean,
            f"{name} RMS [m]": error.rms,
            f"{name} 95% [m]": error.percentile_95,
            f"{name} max [m]": error.maximum,
        }
    for name, one in zip(("surfaces", "map"), maps, strict=True):
        shapes = [surface.control_points.shape for surface in one.surfaces]
        rows |= {f"{name}": len(shapes), f"{name} control points": sum(nu * nv for nu, nv, _ in shapes)}
    return rows
