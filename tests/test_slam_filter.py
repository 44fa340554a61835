"""The line EKF against a dense textbook filter, its derivatives, and what every update must keep."""

import numpy as np
import pytest
from reference import DenseLineFilter, central_differences
from scipy.stats import chi2

from bsmap_cli.core import se2
from bsmap_cli.errors import BsmapError
from bsmap_cli.slam import filter


def random_covariance(rng: np.random.Generator, size: int, scale: float) -> np.ndarray:
    half = rng.normal(size=(size, size))
    return scale**2 * (half @ half.T / size + 0.1 * np.eye(size))


def full_covariance(state: filter.FilterState) -> np.ndarray:
    return filter.gather(state.covariance, np.arange(state.size))


def started(rng: np.random.Generator, lines: int = 8) -> tuple[filter.FilterState, DenseLineFilter]:
    """The same pose and lines in both filters, correlated."""
    pose, P = np.array([3.0, -2.0, 0.7]), random_covariance(rng, 3, 0.05)
    state, twin = filter.initial_state(pose, P), DenseLineFilter(pose, P)
    for _ in range(lines):
        z, R = rng.uniform([-np.pi, 0.5], [np.pi, 6.0]), random_covariance(rng, 2, 0.02)
        state = filter.augment(state, z, R)
        twin.augment(z, R)
    return state, twin


def assert_same(state: filter.FilterState, twin: DenseLineFilter, tolerance: float = 1e-9) -> None:
    difference = state.mean[: state.size] - twin.mean
    difference[2] = se2.wrap(difference[2])
    np.testing.assert_allclose(difference, 0.0, atol=tolerance)
    np.testing.assert_allclose(full_covariance(state), twin.P, atol=tolerance)


def update(state: filter.FilterState, line: int, z: np.ndarray, R: np.ndarray) -> tuple[filter.FilterState, float]:
    return filter.update(state, np.array([line]), z[None], R[None])


def test_expected_lines_are_the_lines_seen_from_the_pose():
    """Points of a map line, carried into the robot's frame, lie on the expected line."""
    rng = np.random.default_rng(0)
    pose, lines = np.array([1.0, 2.0, 2.5]), rng.uniform([-np.pi, -5], [np.pi, 5], (20, 2))
    n, t = (np.stack(f(lines[:, 0]), -1) for f in (lambda a: (np.cos(a), np.sin(a)), lambda a: (-np.sin(a), np.cos(a))))
    points = n * lines[:, 1:] + t * rng.uniform(-3, 3, (20, 1))
    seen = se2.between(pose, np.c_[points, np.zeros(20)])[:, :2]
    alpha, r = filter.expected_lines(pose, lines).T
    np.testing.assert_allclose(seen[:, 0] * np.cos(alpha) + seen[:, 1] * np.sin(alpha), r, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_line_jacobians_match_central_differences(seed):
    rng = np.random.default_rng(seed)
    pose, line = rng.uniform([-50, -50, -np.pi], [50, 50, np.pi]), rng.uniform([-np.pi, -30], [np.pi, 30])
    by_pose, by_line = filter.line_jacobians(pose, line[0])

    def seen_from(x):
        return filter.expected_lines(x, line[None])[0]

    def seen_line(x):
        return filter.expected_lines(pose, x[None])[0]

    np.testing.assert_allclose(by_pose, central_differences(seen_from, pose, angles=(0,)), atol=1e-6)
    np.testing.assert_allclose(by_line, central_differences(seen_line, line, angles=(0,)), atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_augmenting_carries_covariance_by_central_differences(seed):
    """Cross-covariances and the new block are those of the numeric Jacobian of the new line."""
    rng = np.random.default_rng(seed)
    state, _ = started(rng, 2)
    z, R = rng.uniform([-np.pi, 0.5], [np.pi, 6]), random_covariance(rng, 2, 0.02)
    n, mean, P = state.size, state.mean[: state.size].copy(), full_covariance(state)

    def new_line(x):
        alone = filter.augment(filter.initial_state(x[:3]), x[3:], np.zeros((2, 2)))
        return alone.mean[3:5]

    J = central_differences(new_line, np.r_[mean[:3], z], angles=(0,))
    state = filter.augment(state, z, R)
    found = full_covariance(state)
    np.testing.assert_allclose(found[n:, :n], J[:, :3] @ P[:3], atol=1e-8)
    np.testing.assert_allclose(found[n:, n:], J[:, :3] @ P[:3, :3] @ J[:, :3].T + J[:, 3:] @ R @ J[:, 3:].T, atol=1e-8)


def test_predicting_carries_covariance_by_central_differences():
    rng = np.random.default_rng(4)
    state, _ = started(rng, 2)
    u, Q = np.array([0.5, 0.1, -0.3]), random_covariance(rng, 3, 0.03)
    pose, P = state.pose.copy(), full_covariance(state)
    by_pose = central_differences(lambda x: se2.compose(x, u), pose, angles=(2,))
    by_motion = central_differences(lambda x: se2.compose(pose, x), u, angles=(2,))
    found = full_covariance(filter.predict(state, u, Q))
    F = np.eye(len(P))
    F[:3, :3] = by_pose
    wanted = F @ P @ F.T
    wanted[:3, :3] += by_motion @ Q @ by_motion.T
    np.testing.assert_allclose(found, wanted, atol=1e-8)


def test_blocks_equal_dense_filter_over_many_steps():
    """Predict, update, augment, remove and constrain in random order: same mean and covariance to 1e-9."""
    rng = np.random.default_rng(1)
    state, twin = started(rng)
    for _ in range(500):
        u, Q = rng.normal(size=3) * [0.1, 0.01, 0.05], random_covariance(rng, 3, 0.01)
        state = filter.predict(state, u, Q)
        twin.predict(u, Q)
        count = len(state.lines)
        for line in rng.choice(count, min(count, 3), replace=False):
            seen = filter.expected_lines(state.pose, state.lines[line : line + 1])[0]
            R = random_covariance(rng, 2, 0.01)
            z = seen + rng.multivariate_normal(np.zeros(2), R)
            state, distance = update(state, line, z, R)
            assert distance == pytest.approx(twin.update(line, z, R), rel=1e-6, abs=1e-9)
        if count < 45 and rng.uniform() < 0.4:
            z, R = rng.uniform([-np.pi, 0.5], [np.pi, 6.0]), random_covariance(rng, 2, 0.02)
            state = filter.augment(state, z, R)
            twin.augment(z, R)
        if count > 4 and rng.uniform() < 0.2:
            line = int(rng.integers(count))
            state = filter.remove(state, line)
            twin.remove(line)
        if rng.uniform() < 0.05:
            first, second = rng.choice(len(state.lines), 2, replace=False)
            noise = np.diag([3.0, 3.0])  # different lines: a weak tie
            state = filter.constrain_equal(state, first, second, noise)
            twin.constrain_equal(first, second, noise)
    assert_same(state, twin)
    assert state.size > filter.GROWTH  # the buffers have grown on the way


def test_pairs_of_a_scan_correct_as_one_measurement():
    """Two segments of one line and one of another: mean and covariance of the dense update with all rows stacked."""
    rng = np.random.default_rng(3)
    state, _ = started(rng, 6)
    mean, P, lines = state.mean[: state.size].copy(), full_covariance(state), np.array([4, 1, 4])
    R = np.array([random_covariance(rng, 2, 0.01) for _ in lines])
    seen = filter.expected_lines(state.pose, state.lines[lines])
    by_pose, by_line = filter.line_jacobians(state.pose, state.lines[lines, 0])
    H, noise = np.zeros((6, state.size)), np.zeros((6, 6))
    for k, line in enumerate(lines):
        H[2 * k : 2 * k + 2, :3], H[2 * k : 2 * k + 2, 3 + 2 * line : 5 + 2 * line] = by_pose[k], by_line[k]
        noise[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = R[k]
    innovation = 0.01 * rng.normal(size=(3, 2))
    S = H @ P @ H.T + noise
    K = P @ H.T @ np.linalg.inv(S)
    state, distance = filter.update(state, lines, seen + innovation, R)
    assert distance == pytest.approx(innovation.ravel() @ np.linalg.solve(S, innovation.ravel()))
    np.testing.assert_allclose(state.mean[: state.size], mean + K @ innovation.ravel(), atol=1e-10)
    np.testing.assert_allclose(full_covariance(state), P - K @ S @ K.T, atol=1e-12)


def test_scan_without_pairs_changes_nothing():
    state, _ = started(np.random.default_rng(4), 2)
    none = np.zeros(0, int)
    assert filter.update(state, none, np.zeros((0, 2)), np.zeros((0, 2, 2))) == (state, 0.0)


def test_removing_any_line_leaves_the_others_as_they_are():
    for line in range(5):
        state, twin = started(np.random.default_rng(2), 5)
        state = filter.remove(state, line)
        twin.remove(line)
        assert_same(state, twin, 1e-15)
        # What was behind the last entry is clean for the next line.
        z, R = np.array([0.1, 2.0]), np.eye(2) * 1e-4
        twin.augment(z, R)
        assert_same(filter.augment(state, z, R), twin, 1e-14)


def test_update_never_increases_trace():
    rng = np.random.default_rng(5)
    state, _ = started(rng, 20)
    trace = np.trace(full_covariance(state))
    for _ in range(300):
        line, R = int(rng.integers(20)), random_covariance(rng, 2, rng.uniform(0.001, 0.1))
        seen = filter.expected_lines(state.pose, state.lines[line : line + 1])[0]
        state, _ = update(state, line, seen + rng.normal(size=2) * 0.01, R)
        less = np.trace(full_covariance(state))
        assert less <= trace * (1 + 1e-12)
        trace = less


def test_covariance_stays_positive_semidefinite_over_thousands_of_updates():
    """Certain measurements, a large map and a far origin, where P - K S K' loses symmetry and sign."""
    rng = np.random.default_rng(6)
    pose = np.array([2000.0, -1000.0, 0.5])
    state = filter.initial_state(pose, np.diag([0.5, 0.5, 0.1]) ** 2)
    for _ in range(40):
        state = filter.augment(state, rng.uniform([-np.pi, 1], [np.pi, 8]), np.diag([1e-3, 1e-3]) ** 2)
    for _ in range(3000):
        state = filter.predict(state, np.array([0.02, 0, 0.001]), np.diag([1e-3, 1e-3, 1e-4]) ** 2)
        line, R = int(rng.integers(40)), np.diag([1e-4, 1e-4]) ** 2
        seen = filter.expected_lines(state.pose, state.lines[line : line + 1])[0]
        state, _ = update(state, line, seen + 1e-4 * rng.normal(size=2), R)
    P = full_covariance(state)
    scale = np.sqrt(np.diag(P))
    assert np.all(np.isfinite(P))
    assert np.linalg.eigvalsh(P / np.outer(scale, scale)).min() > -1e-7


@pytest.mark.parametrize("offset", [0.0, 500.0, 2000.0])
def test_tracking_holds_far_from_the_origin(offset):
    """A circle driven among eight walls: the error to the truth stays what it is at the origin, millimetres."""
    rng = np.random.default_rng(7)
    truth = np.array([offset, -offset, 0.3])
    state = filter.initial_state(truth, np.zeros((3, 3)))
    near = rng.uniform([-np.pi, 1], [np.pi, 6], (8, 2))
    lines = np.array([filter.augment(filter.initial_state(truth), z, np.eye(2)).lines[0] for z in near])
    noise = np.array([0.002, 0.003])
    for z in near:
        state = filter.augment(state, z + noise * rng.normal(size=2), np.diag(noise) ** 2)
    for _ in range(300):
        u = np.array([0.02, 0.0, 0.02])
        truth = se2.compose(truth, u)
        state = filter.predict(state, u + [2e-3, 1e-3, 1e-3] * rng.normal(size=3), np.diag([2e-3, 1e-3, 1e-3]) ** 2)
        for line in rng.choice(8, 3, replace=False):
            z = filter.expected_lines(truth, lines[line : line + 1])[0] + noise * rng.normal(size=2)
            state, _ = update(state, line, z, np.diag(noise) ** 2)
    error = se2.between(truth, state.pose)
    assert np.hypot(*error[:2]) < 0.008
    assert abs(error[2]) < 0.003


def test_angles_are_compared_round_the_circle():
    state = filter.initial_state(np.array([0, 0, np.pi - 0.01]), np.diag([0.1, 0.1, 0.1]) ** 2)
    state = filter.augment(state, np.array([np.pi - 0.02, 2.0]), np.eye(2) * 1e-6)
    state, distance = update(state, 0, np.array([-np.pi - 0.02, 2.0]), np.eye(2) * 1e-4)
    assert distance < 1e-6
    assert -np.pi <= state.pose[2] < np.pi


def test_tied_lines_become_one_and_the_tie_has_its_noise():
    state, _ = started(np.random.default_rng(8), 3)
    lines = state.lines.copy()
    lines[1] = lines[0] + [0.01, 0.02]
    state.mean[3 : state.size] = lines.ravel()
    tied = filter.constrain_equal(state, 0, 1, np.eye(2) * 1e-12)
    np.testing.assert_allclose(tied.lines[0], tied.lines[1], atol=1e-6)


def test_innovation_covariance_that_is_not_positive_is_an_error():
    state, _ = started(np.random.default_rng(9), 1)
    with pytest.raises(BsmapError, match="no longer positive definite"):
        update(state, 0, np.array([0.0, 1.0]), -np.eye(2))


def test_filter_is_consistent_on_data_of_its_own_model():
    """Poses' and innovations' normalised squared errors over 40 runs lie in their chi-square bands."""
    runs, steps, lines = 40, 30, np.array([[0.0, 3.0], [np.pi / 2, 2.5], [2.5, 4.0], [-1.2, 3.5]])
    Q, R, P0 = np.diag([0.01, 0.005, 0.01]) ** 2, np.diag([0.004, 0.01]) ** 2, np.diag([0.02, 0.02, 0.01]) ** 2
    nees, nis = [], []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        truth = np.zeros(3)
        state = filter.initial_state(rng.multivariate_normal(truth, P0), P0)
        for line in lines:
            z = filter.expected_lines(truth, line[None])[0] + rng.multivariate_normal(np.zeros(2), R)
            state = filter.augment(state, z, R)
        for _ in range(steps):
            u = np.array([0.05, 0.0, 0.03])
            truth = se2.compose(truth, u)
            state = filter.predict(state, u + rng.multivariate_normal(np.zeros(3), Q), Q)
            for k, line in enumerate(lines):
                z = filter.expected_lines(truth, line[None])[0] + rng.multivariate_normal(np.zeros(2), R)
                state, distance = update(state, k, z, R)
                nis.append(distance)
        error = se2.wrap(state.pose - truth)
        nees.append(error @ np.linalg.solve(filter.pose_covariance(state), error))
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 3 * runs)
    assert low < sum(nees) < high
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 2 * len(nis))
    assert low < sum(nis) < high
