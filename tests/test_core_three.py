"""Three unknowns: as numpy solves them, and nothing where nothing is known."""

import numpy as np
import pytest

from bsmap_cli.core.three import solve_three


def upper(A: np.ndarray) -> tuple[float, ...]:
    return tuple(A[np.triu_indices(3)].tolist())


@pytest.mark.parametrize("seed", range(5))
def test_solution_is_numpys(seed):
    rng = np.random.default_rng(seed)
    J, side = rng.normal(size=(10, 3)) * [1.0, 100.0, 0.01], rng.normal(size=3)
    A = J.T @ J
    np.testing.assert_allclose(solve_three(upper(A), tuple(side)), np.linalg.solve(A, side), rtol=1e-9)


@pytest.mark.parametrize("known", range(3))
def test_unknown_of_which_nothing_is_told_stays_zero(known):
    A, side = np.zeros((3, 3)), np.zeros(3)
    A[known, known], side[known] = 4.0, 2.0
    expected = np.zeros(3)
    expected[known] = 0.5
    np.testing.assert_allclose(solve_three(upper(A), tuple(side)), expected)
