"""Banded least squares against dense linear algebra."""

import numpy as np
import pytest

from bsmap_cli.core import leastsquares
from bsmap_cli.core.bspline import basis_functions, clamped_knots, design_matrix
from bsmap_cli.errors import BsmapError

KNOTS = clamped_knots(3, np.arange(1, 10) / 10)
COLUMNS = len(KNOTS) - 4


def some_rows(rng, n=60):
    u = np.sort(rng.random(n))
    first, values = basis_functions(KNOTS, 3, u)
    return first, values[:, 0], design_matrix(KNOTS, 3, u)


def test_fit_equals_dense_least_squares():
    rng = np.random.default_rng(0)
    first, values, N = some_rows(rng)
    data = rng.standard_normal((60, 4))
    solution, factor = leastsquares.fit(first, values, data, COLUMNS)
    np.testing.assert_allclose(solution, np.linalg.lstsq(N, data)[0], atol=1e-10)
    np.testing.assert_allclose(leastsquares.solve(factor, np.eye(COLUMNS)) @ (N.T @ N), np.eye(COLUMNS), atol=1e-9)


def test_normal_matrix_holds_the_lower_bands():
    first, values, N = some_rows(np.random.default_rng(1))
    bands = leastsquares.normal_matrix(first, values, COLUMNS)
    dense = N.T @ N
    for d in range(4):
        np.testing.assert_allclose(bands[d, : COLUMNS - d], np.diag(dense, -d), atol=1e-14)


def test_blocks_in_one_system_are_solved_apart():
    rng = np.random.default_rng(2)
    systems = [some_rows(rng), some_rows(rng)]
    data = rng.standard_normal((2, 60, 1))
    first = np.concatenate([systems[0][0], systems[1][0] + COLUMNS])
    values = np.concatenate([systems[0][1], systems[1][1]])
    together, factor = leastsquares.fit(first, values, data.reshape(120, 1), 2 * COLUMNS)
    columns = np.array([0, 5, COLUMNS - 1])
    variances = leastsquares.block_variances(factor, 2, columns)
    for k, (first_k, values_k, N) in enumerate(systems):
        alone, _ = leastsquares.fit(first_k, values_k, data[k], COLUMNS)
        np.testing.assert_allclose(together[k * COLUMNS : (k + 1) * COLUMNS], alone, atol=1e-10)
        np.testing.assert_allclose(variances[k], np.diag(np.linalg.inv(N.T @ N))[columns], rtol=1e-8)


def test_span_without_data_is_refused():
    u = np.concatenate([np.linspace(0, 0.3, 30), np.linspace(0.9, 1.0, 30)])
    first, values = basis_functions(KNOTS, 3, u)
    with pytest.raises(BsmapError, match="13 unknowns is underdetermined: a knot span lacks data"):
        leastsquares.fit(first, values[:, 0], np.zeros((60, 1)), COLUMNS)
