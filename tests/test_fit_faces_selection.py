"""Knots of height fields: needless ones leave, those that the data pay for stay."""

import numpy as np
import pytest

from bsmap_cli.core.bspline import clamped_knots, inner_knots, open_knots
from bsmap_cli.fit import equations, selection
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.heights import CylinderBase, HeightField, Knots, PlaneBase, basis_matrix, evaluate, least_knots
from bsmap_cli.fit.selection import PRICE, fit_heights, refit

SIGMA = 0.01
PLANE = PlaneBase(np.zeros(3), np.eye(3))
LOW, HIGH = np.zeros(2), np.array([4.0, 2.0])


def blocks_of(height, seed=0, until=4.0):
    """Blocks on a height over (s, t) with noise, seen from above, up to s = `until`."""
    rng = np.random.default_rng(seed)
    s, t = rng.uniform(0.0, (until, 2.0), (3000, 2)).T
    points = np.column_stack([s, t, height(s, t) + SIGMA * rng.standard_normal(len(s))])
    down, one = np.tile([0.0, 0.0, -1.0], (len(s), 1)), np.ones(len(s))
    return Blocks(points, down, one, np.arange(len(s)) // 30, one, np.arange(len(s)))


def field_on(knots):
    return HeightField(PLANE, LOW, HIGH, knots, np.zeros(knots.shape))


def many_knots():
    return Knots(3, 2, clamped_knots(3, np.array([0.25, 0.5, 0.75])), clamped_knots(2, np.array([0.5])))


@pytest.mark.parametrize("seed", range(3))
def test_all_knots_of_a_flat_face_leave(seed):
    fitted = refit(field_on(many_knots()), blocks_of(lambda s, t: 0.1 * s - 0.2 * t, seed), SIGMA, choose=True)
    assert fitted.field.knots.size == 4


def test_the_knot_at_a_bend_stays():
    blocks = blocks_of(lambda s, t: 0.1 * np.maximum(s - 2.0, 0.0) ** 2)
    knots = Knots(2, 1, clamped_knots(2, np.array([0.2, 0.5, 0.7])), open_knots(1))
    fitted = refit(field_on(knots), blocks, SIGMA, choose=True)
    np.testing.assert_array_equal(inner_knots(fitted.field.knots.s, fitted.field.knots.degree_s), [0.5])


def test_least_surface_over_a_cylinder_keeps_its_knots():
    rng = np.random.default_rng(0)
    angle, z = rng.uniform(-2.0, 2.0, 3000), rng.uniform(0.0, 2.0, 3000)
    outwards = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))])
    points = outwards * (1.0 + SIGMA * rng.standard_normal(len(angle)))[:, None] + z[:, None] * [0.0, 0.0, 1.0]
    one = np.ones(len(angle))
    blocks = Blocks(points, outwards, one, np.arange(len(angle)) // 30, one, np.arange(len(angle)))
    base, low, high = CylinderBase(np.zeros(2), 1.0, 0.0), np.array([-2.0, 0.0]), np.array([2.0, 2.0])
    least = least_knots(base, low, high)
    knots = Knots(3, 2, clamped_knots(3, np.array([0.25, 0.5, 0.75])), open_knots(2))
    fitted = refit(HeightField(base, low, high, knots, np.zeros(knots.shape)), blocks, SIGMA, choose=True)
    assert fitted.field.knots.shape == least.shape
    assert fitted.field.knots.degree_s == least.degree_s


def test_a_knot_whose_data_have_gone_to_another_face_leaves():
    blocks = blocks_of(lambda s, t: 0.02 * s**2, until=3.0)
    knots = Knots(2, 1, clamped_knots(2, np.array([0.75, 0.9])), open_knots(1))
    fitted = refit(field_on(knots), blocks, SIGMA, choose=True)
    assert fitted.field.knots.shape == (3, 2)
    np.testing.assert_allclose(fitted.field.heights[-1], 0.02 * 16.0, atol=0.02)


def test_fewer_knots_are_never_the_worse_choice():
    for seed in range(3):
        blocks = blocks_of(lambda s, t: 0.03 * np.sin(2.0 * s) * np.cos(t), seed)
        kept = refit(field_on(many_knots()), blocks, SIGMA)
        fewer = refit(field_on(many_knots()), blocks, SIGMA, choose=True)
        assert fewer.criterion <= kept.criterion + 1e-6
        chosen = fit_heights(blocks, PLANE, LOW, HIGH, SIGMA)
        again = refit(chosen.field, blocks, SIGMA, choose=True)
        assert again.criterion > chosen.criterion - PRICE


def test_knots_that_new_data_pay_for_are_added():
    blocks = blocks_of(lambda s, t: 0.03 * np.sin(2.0 * s) * np.cos(t))
    few = Knots(2, 1, open_knots(2), open_knots(1))
    chosen = fit_heights(blocks, PLANE, LOW, HIGH, SIGMA)
    as_it_is, now = (refit(field_on(few), blocks, SIGMA, choose=choose).criterion for choose in (False, True))
    assert now - chosen.criterion < 0.05 * (as_it_is - chosen.criterion)


def told_share(height, seed, knots):
    """Share of the equations' information that a fit on such knots tells."""
    blocks = blocks_of(height, seed)
    fitted = refit(field_on(knots), blocks, SIGMA)
    data = equations.linearise(fitted.field, blocks, SIGMA)
    raw = selection._solve(knots, data).information
    np.testing.assert_allclose(fitted.information, raw * (share := fitted.information[0, 0] / raw[0, 0]), rtol=1e-3)
    return share


def test_the_least_surface_tells_all_it_knows_and_others_less():
    assert told_share(lambda s, t: 0.1 * s, 0, least_knots(PLANE, LOW, HIGH)) == pytest.approx(1.0)
    assert 0.2 < told_share(lambda s, t: 0.1 * s**2, 0, Knots(2, 1, open_knots(2), open_knots(1))) < 1.0


@pytest.mark.parametrize("height", [lambda s, t: 0.01 * np.sin(3.0 * s), lambda s, t: 0.002 * (s - 2.0) ** 4])
def test_what_the_knots_leave_out_is_taken_from_what_is_told(height):
    knots = Knots(2, 1, open_knots(2), open_knots(1))
    bent = [told_share(height, seed, knots) for seed in range(5)]
    smooth = [told_share(lambda s, t: 0.1 * s**2, seed, knots) for seed in range(5)]
    assert max(bent) < 0.2
    assert np.mean(smooth) > 0.4


def test_finer_knots_follow_what_is_even_and_what_is_odd_about_a_span():
    u = np.linspace(0.0, 1.0, 200)
    for knots, degree in ((open_knots(2), 2), (open_knots(1), 1)):
        finer = selection._finer(Knots(degree, 1, knots, open_knots(1)), 0)
        N = basis_matrix(finer, np.column_stack([u, np.zeros(len(u))]))
        for order in (degree + 1, degree + 2):
            wave = np.polynomial.chebyshev.Chebyshev.basis(order, domain=[0.0, 1.0])(u)
            left = wave - N @ np.linalg.lstsq(N, wave, rcond=None)[0]
            assert np.sum(left**2) < 0.3 * np.sum(wave**2)


def test_knots_are_sought_anew_about_what_was_found():
    """On far too few knots the first surface lies far from the data."""
    blocks = blocks_of(lambda s, t: 0.3 * np.sin(3.0 * s))
    fitted = refit(field_on(Knots(2, 1, open_knots(2), open_knots(1))), blocks, SIGMA, choose=True)
    data = equations.linearise(fitted.field, blocks, SIGMA)
    now = selection._solve(fitted.field.knots, data)
    steps = list(selection._single_steps(now.knots, data, equations.misfits(now.knots, now.heights, data) ** 2))
    assert min(selection._solve(step, data).criterion for step in steps) > now.criterion - 1e-6


def test_covariance_of_bent_faces_holds_their_errors():
    rng = np.random.default_rng(1)
    inside = []
    for seed in range(40):
        # Bends from hardly seen to well seen.
        high, wide, phase = 0.02 * 10.0 ** rng.uniform(-0.7, 0.7), rng.uniform(0.5, 2.0), rng.uniform(0.0, 6.0)
        height = lambda s, t: high * np.sin(wide * s + phase) * np.cos(0.7 * wide * t)  # noqa: B023, E731
        blocks = blocks_of(height, seed)
        fitted = fit_heights(blocks, PLANE, LOW, HIGH, SIGMA)
        if fitted.field.knots.size == 4:
            continue
        fitted = refit(fitted.field, blocks, SIGMA)
        uv = (blocks.points[:, :2] - LOW) / (HIGH - LOW)
        error = evaluate(fitted.field, uv)[0] - height(*blocks.points[:, :2].T)
        N = basis_matrix(fitted.field.knots, uv)
        variance = np.sum((N @ np.linalg.inv(fitted.information)) * N, axis=1)
        inside.append(np.mean(error**2 < 3.84 * variance))
    assert len(inside) > 20
    assert 0.91 < np.mean(inside) < 0.98


@pytest.mark.parametrize("spans", [1, 3, 7, 20])
def test_normal_equations_are_products_of_all_basis_functions(spans):
    """Each span for itself, where there are many; one of them has no data."""
    inner = np.arange(1, spans) / spans
    knots = Knots(3, 2, clamped_knots(3, inner), clamped_knots(2, np.array([0.5])))
    data = equations.linearise(field_on(knots), blocks_of(lambda s, t: 0.1 * np.sin(s) * t, until=3.7), SIGMA)
    A, b = equations.normal_equations(knots, data)
    N = basis_matrix(knots, data.feet.uv) * data.root[:, None]
    np.testing.assert_allclose(A, N.T @ N, atol=1e-9 * A.max())
    np.testing.assert_allclose(b, N.T @ data.wanted, atol=1e-9 * np.abs(b).max())
    heights = np.random.default_rng(0).normal(size=knots.size)
    np.testing.assert_allclose(equations.misfits(knots, heights, data), N @ heights - data.wanted, atol=1e-9)
