"""The pose graph: derivatives, known answers, false closures, graphs that hold no answer."""

import numpy as np
import pytest
from reference import central_differences
from scipy import sparse
from scipy.stats import chi2

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined
from bsmap_cli.errors import BsmapError
from bsmap_cli.slam.posegraph import Edges, factorise, optimise, residuals, weighted

SPREAD = np.array([0.02, 0.02, 0.01])


def edges_between(first, second, relative, spread=SPREAD, robust=False) -> Edges:
    m = len(first)
    information = np.tile(np.diag(1 / np.asarray(spread) ** 2), (m, 1, 1))
    return Edges(np.asarray(first), np.asarray(second), relative, information, np.full(m, robust))


def square(laps: int = 2, side: int = 10) -> np.ndarray:
    """True poses (n, 3): round a square in steps of 1 m, turning in the corners."""
    out = [np.zeros(3)]
    for k in range(1, laps * 4 * side):
        out.append(se2.compose(out[-1], np.array([1.0, 0.0, np.pi / 2 if k % side == 0 else 0.0])))
    return np.array(out)


def noisy_square(seed: int) -> tuple[np.ndarray, np.ndarray, Edges]:
    """True poses, poses added up from the noisy steps, steps and the closures of the second lap to the first."""
    rng = np.random.default_rng(seed)
    truth = square()
    n = len(truth)
    first, second = np.arange(n - 1), np.arange(1, n)
    steps = se2.between(truth[first], truth[second]) + SPREAD * rng.normal(size=(n - 1, 3))
    start = [truth[0]]
    for step in steps:
        start.append(se2.compose(start[-1], step))
    later = np.arange(n // 2, n, 5)
    again = se2.between(truth[later - n // 2], truth[later]) + SPREAD * rng.normal(size=(len(later), 3))
    chain, loops = edges_between(first, second, steps), edges_between(later - n // 2, later, again)
    return truth, np.array(start), joined([chain, loops])


def place_error(poses, truth):
    return np.hypot(*(poses - truth)[:, :2].T)


def test_derivatives_agree_with_central_differences():
    rng = np.random.default_rng(1)
    poses = rng.normal(size=(2, 3)) * [3, 3, 2]
    edges = edges_between([0], [1], rng.normal(size=(1, 3)))

    def error(both):
        return residuals(both.reshape(2, 3), edges)[0][0]

    _, by_first, by_second = residuals(poses, edges)
    naive = central_differences(error, poses.ravel(), angles=(2,))
    np.testing.assert_allclose(np.hstack([by_first[0], by_second[0]]), naive, atol=1e-8)


def test_edges_that_agree_leave_no_error():
    truth = square(1)
    n = len(truth)
    rng = np.random.default_rng(0)
    first, second = np.r_[np.arange(n - 1), 0], np.r_[1:n, n - 1]
    edges = edges_between(first, second, se2.between(truth[first], truth[second]))
    start = truth + 0.1 * rng.normal(size=truth.shape) * (np.arange(n) > 0)[:, None]
    found = optimise(start, edges)
    np.testing.assert_allclose(se2.between(truth, found.poses), 0.0, atol=1e-6)
    assert found.distances.max() < 1e-6


def test_noisy_square_comes_out_as_exact_as_its_closures():
    for seed in range(5):
        truth, start, edges = noisy_square(seed)
        found = optimise(start, edges)
        assert place_error(found.poses, truth).max() < 0.7
        assert place_error(found.poses, truth).mean() < 0.5 * place_error(start, truth).mean()


def test_what_is_left_over_is_chi_square():
    """Over the seeds, the squared distances add up to the redundancy of the graph."""
    totals, dof = [], 0
    for seed in range(20):
        truth, start, edges = noisy_square(100 + seed)
        totals.append(optimise(start, edges).distances.sum())
        dof += 3 * len(edges.first) - 3 * (len(truth) - 1)
    low, high = chi2.ppf([0.001, 0.999], dof)
    assert low < sum(totals) < high


def test_first_pose_is_held():
    _, start, edges = noisy_square(0)
    moved = se2.compose(np.array([5.0, -3.0, 1.0]), start)
    found, again = optimise(start, edges).poses, optimise(moved, edges).poses
    np.testing.assert_array_equal(again[0], moved[0])
    np.testing.assert_allclose(se2.between(again[0], again), se2.between(found[0], found), atol=1e-6)


def test_gross_false_closure_loses_its_weight():
    _, start, edges = noisy_square(3)
    without = optimise(start, edges).poses
    false = edges_between([5], [25], np.zeros((1, 3)), robust=True)
    found = optimise(start, joined([edges, false])).poses
    distance, information = weighted(false, residuals(found, false)[0])
    assert information[0, 0, 0] / false.information[0, 0, 0] < 1e-3
    assert distance[0] > 1e4
    assert place_error(found, without).max() < 0.05


def test_edge_that_is_not_robust_keeps_its_weight():
    edges = edges_between([0, 0], [1, 1], np.zeros((2, 3)))._replace(robust=np.array([False, True]))
    distance, information = weighted(edges, np.full((2, 3), 1.0))
    np.testing.assert_array_equal(information[0], edges.information[0])
    np.testing.assert_allclose(information[1], edges.information[1] / (1 + distance[1] / 9))


def test_one_pose_without_edges_is_its_own_answer():
    none = edges_between(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 3)))
    np.testing.assert_array_equal(optimise(np.ones((1, 3)), none).poses, np.ones((1, 3)))


def test_graph_in_parts_is_refused():
    edges = edges_between([0], [1], np.zeros((1, 3)))
    with pytest.raises(BsmapError, match="falls into parts"):
        optimise(np.zeros((3, 3)), edges)
    with pytest.raises(BsmapError, match="falls into parts"):
        factorise(sparse.csc_matrix((3, 3)))
