import numpy as np
import pytest

from bsmap_cli.core import se2
from bsmap_cli.simulate import robot
from bsmap_cli.simulate.path import along, integrate, poses_at, stepwise


def slow_pose(path, time, step=1e-4):
    """Euler's midpoint rule."""
    x, y, theta = path.poses[0]
    for t in np.arange(step / 2, time, step):
        v, w = path.twists[np.searchsorted(path.time, t) - 1]
        x, y = x + step * v * np.cos(theta + step * w / 2), y + step * v * np.sin(theta + step * w / 2)
        theta += step * w
    return np.array([x, y, theta])


def test_poses_follow_speed_and_turning_rate():
    path = integrate((1.0, 2.0, 0.3), np.array([0.5, 1.0, 0.4]), np.array([[0.5, 0.0], [0.4, 1.2], [0.3, -0.5]]))
    times = np.array([0.2, 0.9, 1.9])
    expected = np.array([slow_pose(path, t) for t in times])
    np.testing.assert_allclose(poses_at(path, times), expected, atol=1e-7)


def test_robot_stands_before_the_start_and_after_the_end():
    path = integrate((1.0, 2.0, 0.3), np.array([1.0]), np.array([[0.5, 0.2]]))
    poses = poses_at(path, np.array([-3.0, 5.0]))
    np.testing.assert_allclose(poses, path.poses)


def test_steps_have_the_length_and_turn_asked_for():
    steps = np.array([[0.1, 0.0]] * 3 + [[0.0, 0.087]] * 2)
    path, times = stepwise((0.0, 0.0, 0.5), steps)
    moved = np.diff(poses_at(path, times), axis=0)
    np.testing.assert_allclose(np.hypot(*moved[:, :2].T), steps[:, 0], atol=1e-12)
    np.testing.assert_allclose(moved[:, 2], steps[:, 1], atol=1e-12)
    np.testing.assert_allclose(poses_at(path, times - 0.05), poses_at(path, times + 0.05), atol=1e-12)


def test_path_along_waypoints_ends_at_the_last_with_smooth_turns():
    waypoints = np.array([[0.0, 0.0], [5.0, 0.0], [5.0, 5.0], [9.0, 4.0]])
    path = along(waypoints, radius=0.9, speed=0.6)
    np.testing.assert_allclose(path.poses[-1], [9.0, 4.0, np.arctan2(-1, 4)], atol=1e-9)
    assert np.abs(np.diff(path.twists[:, 1])).max() < 0.01  # rad/s
    assert np.abs(np.diff(path.twists[:, 0])).max() < 0.01  # m/s
    assert np.isclose(np.abs(path.twists[:, 1]).max(), 0.6 / 0.9, rtol=0.01)


def test_waypoints_too_near_for_the_arcs_are_refused():
    with pytest.raises(ValueError, match="too near"):
        along(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), radius=2.0, speed=0.5)


@pytest.mark.parametrize("vertices", [[[0, 0], [9, 0], [9, 6], [2, 3]]])
def test_odometry_without_error_is_the_true_motion(vertices):
    path = along(np.array(vertices, dtype=float), radius=0.8, speed=0.5)
    time = np.arange(0.0, path.time[-1] + 1.0, 0.07)
    odometry = robot.odometry(path, time, 0.0, np.random.default_rng(1))
    true = poses_at(path, time)
    np.testing.assert_allclose(se2.compose(true[0], odometry)[:, :2], true[:, :2], atol=1e-9)
    np.testing.assert_allclose(se2.wrap(se2.compose(true[0], odometry)[:, 2] - true[:, 2]), 0.0, atol=1e-9)


def ends(path, error, seeds=60):
    time = np.linspace(0.0, path.time[-1], 200)
    return np.array([robot.odometry(path, time, error, np.random.default_rng(s))[-1] for s in range(seeds)])


def test_odometry_drifts_by_one_or_two_percent_of_the_way():
    straight = integrate((0, 0, 0), np.array([100.0]), np.array([[0.5, 0.0]]))
    error = ends(straight, 1.0) - [50.0, 0.0, 0.0]
    assert 0.008 < np.sqrt(np.mean(error[:, 0] ** 2)) / 50 < 0.013
    assert 0.008 < np.sqrt(np.mean(np.sum(error[:, :2] ** 2, axis=1))) / 50 < 0.02


def test_odometry_drifts_by_one_or_two_degrees_a_turn():
    turning = integrate((0, 0, 0), np.array([10.0]), np.array([[0.0, 2 * np.pi / 10]]))
    error = se2.wrap(ends(turning, 1.0)[:, 2])
    assert 1.0 < np.degrees(np.sqrt(np.mean(error**2))) < 2.0


def test_odometry_error_scales():
    turning = integrate((0, 0, 0), np.array([10.0]), np.array([[0.3, 0.2]]))
    exact = ends(turning, 0.0, 1)
    small, large = (np.abs(ends(turning, e) - exact).mean(axis=0) for e in (0.1, 1.0))
    np.testing.assert_allclose(large / small, 10.0, rtol=0.1)


def test_vertical_laser_looks_up_and_to_the_left():
    path = integrate((1.0, 2.0, np.pi / 2), np.array([1.0]), np.zeros((1, 2)))
    middle, left = robot.VERTICAL.beams // 2, robot.VERTICAL.beams // 2 + 180
    origins, directions = robot.beam_rays(robot.VERTICAL, path, np.zeros((1, robot.VERTICAL.beams)))
    np.testing.assert_allclose(origins[0, 0], [1.0, 1.95, 0.6], atol=1e-9)
    np.testing.assert_allclose(directions[0, middle], [0.0, 0.0, 1.0], atol=1e-6)
    np.testing.assert_allclose(directions[0, left], [-1.0, 0.0, 0.0], atol=1e-6)


def test_mounts_are_rotations():
    for laser in (robot.HORIZONTAL, robot.VERTICAL):
        rotation = laser.mount[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.isclose(np.linalg.det(rotation), 1.0)
