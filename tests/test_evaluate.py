from types import SimpleNamespace

import numpy as np
import pytest
from scenes import simulated, true_slam_map

from bsmap_cli.core import se2
from bsmap_cli.core.bspline import TensorSpline
from bsmap_cli.errors import BsmapError
from bsmap_cli.evaluate import align, distance_to_mesh, fit_pose, summary, surface_samples, transform_points
from bsmap_cli.model import Trajectory
from bsmap_cli.simulate.geometry import arc, carve, room, upright


def trajectory(time_ns, poses):
    return Trajectory(np.asarray(time_ns), np.asarray(poses, dtype=float), np.zeros((len(poses), 3, 3)))


def some_poses(n=50, seed=0):
    return np.random.default_rng(seed).uniform([-5, -5, -3], [5, 5, 3], (n, 3))


def test_moved_trajectory_is_laid_over_its_truth():
    pose, poses = np.array([3.0, -2.0, 2.8]), some_poses()
    time_ns = np.arange(50) * 10**8
    found = align(trajectory(time_ns, poses), trajectory(time_ns, se2.compose(pose, poses)))
    np.testing.assert_allclose(found.pose, pose, atol=1e-12)
    np.testing.assert_allclose([found.rms, found.maximum, found.heading_rms], 0.0, atol=1e-12)


def test_errors_left_after_alignment_are_measured():
    time_ns = np.arange(4) * 10**8
    square = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]], dtype=float)
    stretched = square * 1.1 + [7.0, 0.0, 0.2]
    found = align(trajectory(time_ns, stretched), trajectory(time_ns, square))
    np.testing.assert_allclose(found.pose, [-7, 0, 0], atol=1e-12)
    np.testing.assert_allclose([found.rms, found.maximum, found.heading_rms], [0.1 * 2**0.5, 0.1 * 2**0.5, 0.2])


def test_truth_is_interpolated_and_times_outside_are_left_out():
    truth = trajectory([0, 10**9], [[0, 0, 0], [2, 0, 0]])
    estimate = trajectory([-5, 0, 5 * 10**8, 10**9, 2 * 10**9], [[9, 9, 9], [0, 1, 0], [1, 1, 0], [2, 1, 0], [9, 9, 9]])
    found = align(estimate, truth)
    assert found.pairs == 3
    np.testing.assert_allclose(found.pose, [0, -1, 0], atol=1e-12)
    assert found.maximum < 1e-12


def test_trajectories_of_different_times_are_refused():
    with pytest.raises(BsmapError, match="0 of 2 poses"):
        align(trajectory([0, 1], np.zeros((2, 3))), trajectory([5, 6], np.zeros((2, 3))))


def test_fitted_pose_is_the_least_squares_one():
    rng = np.random.default_rng(3)
    source = rng.uniform(-3, 3, (30, 2))
    target = se2.transform(np.array([1.0, 2.0, -0.7]), source) + 0.1 * rng.standard_normal((30, 2))
    pose = fit_pose(source, target)
    best = np.sum((se2.transform(pose, source) - target) ** 2)
    for step in 1e-3 * np.concatenate([np.eye(3), -np.eye(3)]):
        assert np.sum((se2.transform(pose + step, source) - target) ** 2) > best


def test_points_are_transformed_in_the_plane():
    moved = transform_points(np.array([1.0, 0.0, np.pi / 2]), np.array([[2.0, 0.0, 5.0]]))
    np.testing.assert_allclose(moved, [[1.0, 2.0, 5.0]], atol=1e-12)


def test_distances_to_a_box_are_those_of_geometry_far_from_the_origin():
    mesh = carve([room(1000, 1040, 500, 530, 0, 3)])
    points = np.random.default_rng(0).uniform([1000, 500, 0], [1040, 530, 3], (1000, 3))
    expected = np.minimum(points - [1000, 500, 0], [1040, 530, 3] - points).min(axis=1)
    np.testing.assert_allclose(distance_to_mesh(points, *mesh), expected, atol=1e-5)


def test_distance_outside_counts_to_the_nearest_corner():
    mesh = carve([room(0, 1, 0, 1, 0, 1)])
    np.testing.assert_allclose(distance_to_mesh(np.array([[2.0, 3.0, 3.0]]), *mesh), [3.0], atol=1e-6)


def test_distances_agree_with_a_slow_twin():
    rng = np.random.default_rng(5)
    corners, points = rng.uniform(0, 1, (20, 3, 3)), rng.uniform(-0.5, 1.5, (40, 3))
    a, b = (g.ravel() for g in np.meshgrid(*2 * [np.linspace(0, 1, 201)]))
    weights = np.column_stack([1 - a - b, a, b])[a + b <= 1 + 1e-12]
    on_triangles = (weights @ corners).reshape(-1, 3)
    expected = [np.linalg.norm(on_triangles - p, axis=1).min() for p in points]
    found = distance_to_mesh(points, corners.reshape(-1, 3), np.arange(60).reshape(-1, 3))
    np.testing.assert_allclose(found, expected, atol=1e-3)
    assert np.all(found <= np.array(expected) + 1e-9)


def test_distance_is_exact_at_long_thin_triangles():
    mesh = upright(arc((20.0, 3.0), 0.25, 0.0, 2 * np.pi, np.radians(2.0)), 0.0, 3.2)
    weights = np.random.default_rng(2).dirichlet([1, 1, 1], (len(mesh.triangles), 5))
    points = np.einsum("mki,mij->mkj", weights, mesh.vertices[mesh.triangles]).reshape(-1, 3)
    assert distance_to_mesh(points, *mesh).max() < 1e-5


def test_summary_of_known_distances():
    found = summary(np.arange(101) / 100)
    assert found.points == 101
    np.testing.assert_allclose([found.mean, found.percentile_95, found.maximum], [0.5, 0.95, 1.0])
    np.testing.assert_allclose(found.rms, np.sqrt(201 / 600))
    assert summary(np.array([])).points == 0


def plane(width, height):
    corners = np.array([[[0, 0, 1], [0, height, 1]], [[width, 0, 1], [width, height, 1]]], dtype=float)
    return TensorSpline(1, 1, np.array([0, 0, 1, 1.0]), np.array([0, 0, 1, 1.0]), corners)


def test_surface_samples_are_a_step_apart_and_reach_the_corners():
    samples = surface_samples(SimpleNamespace(surfaces=(plane(2.0, 1.0),)), 0.1)
    assert samples.shape == (21 * 11, 3)
    for corner in ([0, 0, 1], [2, 1, 1]):
        assert np.linalg.norm(samples - corner, axis=1).min() < 1e-12
    assert np.allclose(np.diff(np.unique(samples[:, 0].round(9))), 0.1)


def test_samples_follow_the_length_of_a_surface_not_its_parameter():
    crowded = plane(1.0, 1.0)._replace(
        degree_u=2, knots_u=np.array([0, 0, 0, 1, 1, 1.0]),
        control_points=np.array([[[x, 0, 0], [x, 1, 0]] for x in (0.0, 0.0, 1.0)]),
    )  # fmt: skip
    x = np.unique(surface_samples(SimpleNamespace(surfaces=(crowded,)), 0.05)[:, 0].round(9))
    np.testing.assert_allclose(np.diff(x), 0.05, rtol=0.1)


def test_map_without_surfaces_has_no_samples():
    assert surface_samples(SimpleNamespace(surfaces=()), 0.1).shape == (0, 3)


def test_true_poses_put_the_scans_onto_the_scene():
    simulation = simulated("room", range_sigma=0.0)
    slam_map = true_slam_map(simulation)
    found = align(slam_map.trajectory, simulation.truth)
    assert found.maximum < 1e-9
    vertical = simulation.log.vertical
    beams = np.stack([np.cos(vertical.angles), np.sin(vertical.angles), np.zeros(541), np.full(541, np.nan)], axis=-1)
    in_laser = vertical.ranges[40, :, None] * beams
    in_laser[:, 3] = 1.0
    in_base = in_laser @ vertical.mount.T
    points = transform_points(found.pose, transform_points(slam_map.trajectory.poses[40], in_base[:, :3]))
    assert distance_to_mesh(points, simulation.vertices, simulation.triangles).max() < 1e-5
