"""Gaussian estimates: gates, packed matrices, roots, distances, products; the noise of ranges from the ranges."""

import numpy as np
import pytest
from scipy.stats import chi2, multivariate_normal

from bsmap_cli.core.gaussian import (
    chi2_gate,
    noncentrality,
    pack,
    product,
    rounded_root,
    squared_distance,
    squared_distance_2,
    symmetric_sqrt,
    unpack,
)
from bsmap_cli.core.noise import FLOOR, range_sigma
from bsmap_cli.errors import BsmapError


def covariances(count: int, size: int = 3, seed: int = 0) -> np.ndarray:
    half = np.random.default_rng(seed).normal(size=(count, size, size))
    return half @ half.swapaxes(1, 2) + 0.01 * np.eye(size)


@pytest.mark.parametrize("probability", [0.5, 0.95, 0.99, 0.999999])
@pytest.mark.parametrize("dof", [1, 2, 10, 80])
def test_gate_is_the_quantile_of_chi_square(probability, dof):
    assert chi2_gate(probability, dof) == pytest.approx(chi2.ppf(probability, dof), rel=1e-9)


def test_packed_matrices_come_back_and_hold_the_upper_triangle_by_rows():
    matrices = covariances(7)
    np.testing.assert_array_equal(unpack(pack(matrices)), (matrices + matrices.swapaxes(1, 2)) / 2)
    np.testing.assert_array_equal(unpack(np.arange(6.0)), [[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def test_square_roots_squared_are_the_matrices_even_singular_ones():
    matrices = covariances(20)
    matrices[0] = np.outer([1, 2, 3], [1, 2, 3])
    matrices[1] = 0.0
    roots = symmetric_sqrt(matrices)
    np.testing.assert_allclose(roots, roots.swapaxes(1, 2), atol=1e-12)
    np.testing.assert_allclose(roots @ roots, matrices, atol=1e-10)


def test_squared_distance_is_the_quadratic_form():
    matrices = covariances(9)
    d = np.random.default_rng(1).normal(size=(9, 3))
    wanted = [x @ np.linalg.inv(C) @ x for x, C in zip(d, matrices, strict=True)]
    np.testing.assert_allclose(squared_distance(d, matrices), wanted, rtol=1e-9)


def test_distance_under_a_singular_covariance_is_refused():
    with pytest.raises(BsmapError, match="covariance is singular"):
        squared_distance(np.ones(2), np.zeros((2, 2)))


def test_product_is_the_normalised_product_of_densities():
    A, B = covariances(2, seed=3)
    a, b = np.random.default_rng(2).normal(size=(2, 3))
    mean, C = product(a, A, b, B)
    np.testing.assert_allclose(np.linalg.inv(C), np.linalg.inv(A) + np.linalg.inv(B), rtol=1e-8, atol=1e-8)
    at = np.random.default_rng(4).normal(size=(50, 3))
    logs = [multivariate_normal(m, P).logpdf(at) for m, P in ((a, A), (b, B), (mean, C))]
    # The product differs from the density by a constant factor only.
    np.testing.assert_allclose(np.ptp(logs[0] + logs[1] - logs[2]), 0.0, atol=1e-8)


def test_product_with_a_certain_value_is_that_value():
    A = covariances(1)[0]
    mean, C = product(np.zeros(3), A, np.ones(3), np.zeros((3, 3)))
    np.testing.assert_allclose(mean, 1.0, atol=1e-12)
    np.testing.assert_allclose(C, 0.0, atol=1e-12)


def box_ranges(scans: int, beams: int, fov: float, rng: np.random.Generator) -> np.ndarray:
    """Exact ranges (scans, beams) in a room of 8 m x 6 m from random poses."""
    x, y = rng.uniform(1, 7, (scans, 1)), rng.uniform(1, 5, (scans, 1))
    d = rng.uniform(0, 2 * np.pi, (scans, 1)) + np.linspace(0, fov, beams)
    c, s = np.cos(d), np.sin(d)
    return np.minimum(np.where(c > 0, 8 - x, -x) / c, np.where(s > 0, 6 - y, -y) / s)


@pytest.mark.parametrize("sigma", [0.003, 0.01, 0.03])
@pytest.mark.parametrize(("beams", "fov"), [(180, np.pi), (541, 1.5 * np.pi)])
def test_range_sigma_is_found_within_a_fifth(sigma, beams, fov):
    rng = np.random.default_rng(0)
    ranges = box_ranges(200, beams, fov, rng)
    ranges += sigma * rng.normal(size=ranges.shape)
    ranges[rng.uniform(size=ranges.shape) < 0.1] = np.nan
    assert range_sigma(ranges.astype(np.float32)) == pytest.approx(sigma, rel=0.2)


def test_range_sigma_of_rounded_ranges_is_of_the_size_of_the_steps():
    """Ranges in whole centimetres: a step's own noise is 0.01 / sqrt(12)."""
    rng = np.random.default_rng(0)
    exact = box_ranges(200, 361, np.pi, rng)
    for sigma in (0.0, 0.003, 0.01):
        found = range_sigma(np.round(exact + sigma * rng.normal(size=exact.shape), 2))
        wanted = np.hypot(sigma, 0.01 / np.sqrt(12))
        assert 0.6 * wanted < found < 2.2 * wanted


def test_range_sigma_without_noise_is_the_floor_and_without_neighbours_a_centimetre():
    assert range_sigma(np.full((5, 50), 3.0)) == FLOOR
    for empty in (np.zeros((0, 50)), np.full((5, 50), np.nan), np.ones((5, 2))):
        assert range_sigma(empty) == 0.01


def test_range_sigma_does_not_see_edges():
    rng = np.random.default_rng(1)
    ranges = np.repeat(rng.uniform(1, 9, (100, 20)), 18, axis=1) + 0.01 * rng.normal(size=(100, 360))
    assert range_sigma(ranges) == pytest.approx(0.01, rel=0.2)


def test_rounded_root_gives_the_covariance_back_and_is_its_own_root():
    rng, unit = np.random.default_rng(0), 1e-8
    for _ in range(50):
        F = np.tril(rng.normal(size=(8, 8))) * np.exp(rng.uniform(-10.0, -5.0, 8)) + 1e-5 * np.eye(8)
        C = F @ F.T
        L = rounded_root(C, unit, 20.0)
        if L is None:
            continue
        assert np.array_equal(L, np.tril(np.rint(L)))
        deviations = np.sqrt(np.diag(C))
        assert np.all(np.abs(L @ L.T * unit**2 - C) <= 2.0 * unit * np.maximum(deviations[:, None], deviations))
        np.testing.assert_array_equal(rounded_root(L @ L.T * unit**2, unit, 20.0), L)


def test_rounded_root_keeps_what_is_small_between_large_deviations():
    """Corners that are hardly known, a middle that is: its variance is a small difference of large numbers."""
    common = 0.002 * np.array([1.0, -1.0, 1.0, -1.0])
    C = np.outer(common, common) + 3e-5**2 * np.eye(4)
    L, middle = rounded_root(C, 1e-8, 200.0) * 1e-8, np.full(4, 0.25)
    assert middle @ (L @ L.T) @ middle == pytest.approx(middle @ C @ middle, rel=0.02)


def test_nearly_singular_covariance_has_no_rounded_root():
    F = np.random.default_rng(1).normal(size=(6, 2)) * 1e-3
    assert rounded_root(F @ F.T, 1e-8, 200.0) is None


def test_squared_distance_in_two_dimensions_is_that_in_any():
    rng = np.random.default_rng(4)
    half = rng.normal(size=(20, 2, 2))
    covariance, difference = half @ half.swapaxes(1, 2), rng.normal(size=(20, 2))
    np.testing.assert_allclose(squared_distance_2(difference, covariance), squared_distance(difference, covariance))


def test_noncentrality_is_the_mean_of_what_may_be():
    for square in (0.0, 1.0, 30.0, 900.0):
        assert noncentrality(square, 2.0) == pytest.approx(square + 2.0)
    assert noncentrality(1e4, 6.0) == pytest.approx(9998.0, abs=0.1)
    values = [noncentrality(square, 6.0) for square in np.linspace(0.0, 60.0, 30)]
    assert np.all(np.diff(values) > 0.0)


def test_noncentrality_of_many_chi_squares_is_right_in_the_mean():
    rng = np.random.default_rng(0)
    means = rng.uniform(0.0, 60.0, 20000)
    squares = rng.noncentral_chisquare(6.0, means)
    found = np.array([noncentrality(square, 6.0) for square in squares])
    for low, high in ((5.0, 15.0), (15.0, 30.0), (30.0, 45.0)):
        some = (squares > low) & (squares < high)
        assert found[some].mean() == pytest.approx(means[some].mean(), rel=0.1)
