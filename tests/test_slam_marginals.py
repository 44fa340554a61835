"""Marginal covariances against the dense inverse."""

import numpy as np
import pytest
from scipy import sparse

from bsmap_cli.errors import BsmapError
from bsmap_cli.slam.marginals import marginals


def graph(poses: int, lines: int, seed: int = 0) -> np.ndarray:
    """Dense information of all but the first pose: a chain, and lines seen from some poses."""
    rng = np.random.default_rng(seed)
    size = 3 * poses + 2 * lines
    information = np.zeros((size, size))

    def observe(columns: np.ndarray, rows: int) -> None:
        J = np.zeros((rows, size))
        J[:, columns] = rng.normal(size=(rows, len(columns)))
        information[:] += J.T @ J

    for k in range(poses - 1):
        observe(np.arange(3 * k, 3 * k + 6), 3)
    for line in range(lines):
        for pose in rng.choice(poses, 3):
            columns = np.r_[3 * pose + np.arange(3), 3 * poses + 2 * line + np.arange(2)]
            observe(columns, 2)
    return information[3:, 3:]


def blocks(inverse: np.ndarray, first: int, count: int, size: int) -> np.ndarray:
    at = first + size * np.arange(count)[:, None] + np.arange(size)
    return inverse[at[:, :, None], at[:, None, :]]


@pytest.mark.parametrize(("poses", "lines"), [(2, 0), (2, 1), (40, 7), (120, 90)])
def test_every_block_is_that_of_the_dense_inverse(poses, lines):
    information = graph(poses, lines)
    found = marginals(sparse.csc_matrix(information), poses, lines)
    inverse = np.linalg.inv(information)
    np.testing.assert_array_equal(found.poses[0], 0.0)
    np.testing.assert_allclose(found.poses[1:], blocks(inverse, 0, poses - 1, 3), rtol=1e-6, atol=1e-9)
    for k in range(poses - 2):
        np.testing.assert_allclose(
            found.following[k + 1], inverse[3 * k : 3 * k + 3, 3 * k + 3 : 3 * k + 6], rtol=1e-6, atol=1e-9
        )
    np.testing.assert_array_equal(found.following[[0, -1]], 0.0)
    np.testing.assert_allclose(found.lines, blocks(inverse, 3 * (poses - 1), lines, 2), rtol=1e-6, atol=1e-9)


def test_blocks_are_symmetric_to_the_last_bit():
    found = marginals(sparse.csc_matrix(graph(60, 20)), 60, 20)
    for P in (found.poses, found.lines):
        np.testing.assert_array_equal(P, P.swapaxes(1, 2))


def test_one_pose_alone_is_known_exactly():
    found = marginals(sparse.csc_matrix((0, 0)), 1, 0)
    np.testing.assert_array_equal(found.poses, np.zeros((1, 3, 3)))
    assert found.lines.shape == (0, 2, 2)


def test_long_chain_is_interpolated_between_poses_that_are_exact():
    """A chain of equal steps: the covariance grows in proportion to the way, which interpolation gives back."""
    n, step = 1000, np.diag([100.0, 100.0, 400.0])
    J = sparse.diags_array([np.ones(n - 1), -np.ones(n - 2)], offsets=[0, -1], format="csc")
    found = marginals(sparse.csc_matrix(sparse.kron(J.T @ J, step)), n, 0)
    expected = np.arange(n)[:, None, None] * np.linalg.inv(step)
    np.testing.assert_allclose(found.poses, expected, rtol=1e-6, atol=1e-12)


def test_lines_of_a_long_chain_are_as_the_dense_inverse_tells(monkeypatch):
    """Poses err alike from one to the next, so that those between the ones solved for may be interpolated."""
    n, lines, step = 200, 30, np.diag([1e4, 1e4, 1e6])
    rng = np.random.default_rng(3)
    J = sparse.diags_array([np.ones(n - 1), -np.ones(n - 2)], offsets=[0, -1], format="csc")
    information = np.zeros((3 * (n - 1) + 2 * lines,) * 2)
    information[: 3 * (n - 1), : 3 * (n - 1)] = sparse.kron(J.T @ J, step).toarray()
    for line in range(lines):
        for pose in np.arange(5) + rng.integers(n - 6):
            columns = np.r_[3 * pose + np.arange(3), 3 * (n - 1) + 2 * line + np.arange(2)]
            rows = np.c_[rng.normal(size=(2, 3)), np.eye(2)]
            information[np.ix_(columns, columns)] += 1e2 * rows.T @ rows
    monkeypatch.setattr("bsmap_cli.slam.marginals.MOST_POSES", 60)
    found = marginals(sparse.csc_matrix(information), n, lines).lines
    wanted = blocks(np.linalg.inv(information), 3 * (n - 1), lines, 2)
    np.testing.assert_allclose(np.trace(found, axis1=1, axis2=2), np.trace(wanted, axis1=1, axis2=2), rtol=0.05)


def test_modes_are_what_the_errors_of_all_poses_have_in_common():
    """A common shift of all poses but the first, and noise of their own: one mode, the same for all."""
    n, common, own = 40, np.array([0.05, 0.03, 0.01]), np.array([0.002, 0.002, 0.001])
    ones = np.ones((n - 1, n - 1))
    joint = np.kron(ones, np.diag(common**2)) + np.kron(np.eye(n - 1), np.diag(own**2))
    found = marginals(sparse.csc_matrix(np.linalg.inv(joint)), n, 0).modes
    np.testing.assert_array_equal(found[0], 0.0)
    assert found.shape == (n, 3, 3)
    for a, b in [(1, 1), (1, 20), (39, 5)]:
        np.testing.assert_allclose(found[a] @ found[b].T, np.diag(common**2), rtol=0.05, atol=1e-9)


def test_modes_hold_no_more_than_the_covariance():
    information = graph(60, 20)
    found = marginals(sparse.csc_matrix(information), 60, 20)
    assert 0 < found.modes.shape[2] <= 12
    joint = np.linalg.inv(information)[: 3 * 59, : 3 * 59]
    L = found.modes[1:].reshape(3 * 59, -1)
    assert np.linalg.eigvalsh(joint - L @ L.T).min() > -1e-9


def test_what_nothing_observes_has_no_covariance():
    information = graph(5, 1)
    information[-2:, :] = information[:, -2:] = 0.0
    with pytest.raises(BsmapError):
        marginals(sparse.csc_matrix(information), 5, 1)
