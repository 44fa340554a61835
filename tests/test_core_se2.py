"""Poses in the plane: group laws, derivatives against central differences, interpolation."""

import numpy as np
import pytest
from reference import central_differences

from bsmap_cli.core import se2


def poses(count: int, seed: int = 0, spread: float = 20.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-spread, spread, (count, 2)), rng.uniform(-np.pi, np.pi, count)])


def matrix(pose: np.ndarray) -> np.ndarray:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, pose[0]], [s, c, pose[1]], [0.0, 0.0, 1.0]])


def assert_same_poses(one: np.ndarray, other: np.ndarray, tolerance: float = 1e-12) -> None:
    difference = one - other
    difference[..., 2] = se2.wrap(difference[..., 2])
    np.testing.assert_allclose(difference, 0.0, atol=tolerance)


def test_wrap_keeps_the_direction_and_stays_in_its_interval():
    angles = np.concatenate([np.linspace(-20, 20, 1001), np.pi * np.arange(-5, 6)])
    wrapped = se2.wrap(angles)
    assert wrapped.min() >= -np.pi
    assert wrapped.max() < np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-12)


def test_compose_is_the_product_of_matrices():
    for a, b in zip(poses(50, 1), poses(50, 2), strict=True):
        np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-12)


def test_between_undoes_compose():
    a, b = poses(200, 3), poses(200, 4)
    assert_same_poses(se2.compose(a, se2.between(a, b)), b)
    assert_same_poses(se2.between(a, se2.compose(a, b)), b)


@pytest.mark.parametrize("seed", range(5))
def test_compose_jacobians_match_central_differences(seed):
    a, b = poses(2, seed)
    by_a, by_b = se2.compose_jacobians(a, b)
    np.testing.assert_allclose(by_a, central_differences(lambda x: se2.compose(x, b), a, angles=(2,)), atol=1e-7)
    np.testing.assert_allclose(by_b, central_differences(lambda x: se2.compose(a, x), b, angles=(2,)), atol=1e-7)


def test_transform_carries_points_of_each_pose():
    frames, points = poses(30, 5), poses(30, 6)[:, :2]
    wanted = [(matrix(f) @ [*p, 1.0])[:2] for f, p in zip(frames, points, strict=True)]
    np.testing.assert_allclose(se2.transform(frames, points), wanted, atol=1e-12)


def test_from_matrix_reads_place_and_turn_about_z():
    for pose in poses(10, 7):
        mount = np.eye(4)
        mount[:2, :2], mount[:2, 3], mount[2, 3] = matrix(pose)[:2, :2], pose[:2], 0.7
        assert_same_poses(se2.from_matrix(mount), pose)


def test_interpolate_goes_the_short_way_round_and_stops_at_the_ends():
    start = 1_700_000_000_000_000_000
    time_ns = start + np.array([0, 100, 300], dtype=np.int64)
    path = np.array([[0.0, 0.0, 3.1], [1.0, 2.0, -3.1], [3.0, 2.0, -3.0]])
    at = start + np.array([-50, 0, 50, 100, 200, 300, 999], dtype=np.int64)
    found = se2.interpolate(time_ns, path, at)
    np.testing.assert_allclose(found[[0, 1, 3, 5, 6]], path[[0, 0, 1, 2, 2]], atol=1e-12)
    np.testing.assert_allclose(np.cos(found[2, 2]), -1.0, atol=1e-12)
    np.testing.assert_allclose(se2.interpolate(time_ns[:1], path[:1], at), np.repeat(path[:1], 7, axis=0))


def test_interpolate_follows_the_arc_between_poses():
    """Circle of 2 m, straight line, turn on the spot and a stand: constant twists, at times without order."""
    rng = np.random.default_rng(3)
    time_ns = np.arange(4, dtype=np.int64) * 1_000_000_000
    at = rng.integers(0, time_ns[-1], 50)
    start = np.array([1.0, -2.0, 2.5])
    for speed, rate in ((0.8, 0.4), (0.8, -1.5), (1.0, 0.0), (1.0, 1e-13), (0.0, 0.7), (0.0, 0.0)):

        def there(ns, speed=speed, rate=rate):
            t = ns * 1e-9
            r = speed / rate if rate else 0.0
            x, y = (r * np.sin(rate * t), r * (1 - np.cos(rate * t))) if abs(rate) > 1e-9 else (speed * t, 0.0 * t)
            return se2.compose(start, np.stack([x, y, rate * t], axis=1))

        assert_same_poses(se2.interpolate(time_ns, there(time_ns), at), there(at))
    # Stamps that come twice: what came last counts from there on.
    twice = np.array([0, 10, 10, 20])
    path = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0], [6, 0, 0]])
    np.testing.assert_allclose(se2.interpolate(twice, path, np.array([5, 10, 15]))[:, 0], [0.5, 5.0, 5.5])
