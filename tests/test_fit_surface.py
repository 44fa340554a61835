"""Curves and surfaces: known splines come back, knots come and stop as they should, covariance is calibrated."""

import numpy as np
import pytest
from scipy.stats import chi2

from bsmap_cli.core.bspline import (
    TensorSpline,
    clamped_knots,
    design_matrix,
    evaluate_curve,
    evaluate_grid,
    evaluate_surface,
    open_knots,
)
from bsmap_cli.core.gaussian import pack, unpack
from bsmap_cli.core.uncertainty import sensor_covariance
from bsmap_cli.errors import BsmapError
from bsmap_cli.fit.curves import Rows, centripetal, fit_curves, schoenberg_whitney
from bsmap_cli.fit.lines import ScanLines
from bsmap_cli.fit.refinement import refine_curves
from bsmap_cli.fit.surface import fit_scan_lines, mean_centripetal
from bsmap_cli.model import BSplineSurface, Residuals, SurfaceCovariance
from bsmap_cli.params import FitParams

SIGMA = 0.01


def rows_of(u, data):
    """Rows without allowance from parameters (rows, n) and points (rows, n, 3)."""
    count, n = u.shape
    return Rows(u.ravel(), np.repeat(np.arange(count), n), data.reshape(-1, 1, 3), np.zeros((count * n, 1)))


def wavy_lines(rng, lines=20, beams=200, sigma=SIGMA):
    """Scan lines of a smooth tunnel, noise of `sigma` in all directions."""
    y, t = np.meshgrid(0.1 * np.arange(lines), np.linspace(0, np.pi, beams), indexing="ij")
    radius = 2 + 0.2 * np.sin(3 * t) * np.cos(y)
    points = np.stack([radius * np.cos(t), y, radius * np.sin(t)], axis=2)
    points += sigma * rng.standard_normal(points.shape)
    covariances = np.tile(pack(np.eye(3) * sigma**2), (lines * beams, 1))
    return ScanLines(points.reshape(-1, 3), *np.divmod(np.arange(lines * beams), beams), covariances)


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
def test_curves_recover_known_control_points(degree):
    rng = np.random.default_rng(degree)
    knots = clamped_knots(degree, [0.2, 0.35, 0.5, 0.8])
    control_points = rng.standard_normal((4, len(knots) - degree - 1, 3))
    u = np.sort(rng.random((4, 300)), axis=1)
    data = np.stack([evaluate_curve(knots, degree, P, x) for P, x in zip(control_points, u, strict=True)])
    fit = fit_curves(rows_of(u, data), knots, degree)
    np.testing.assert_allclose(fit.control_points[:, :, 0], control_points, atol=1e-10)
    assert fit.errors.max() < 1e-10


def test_surface_in_two_passes_recovers_known_control_points():
    """Curves along u, then curves through their control points along v: a tensor-product surface comes back."""
    rng = np.random.default_rng(0)
    knots_u, knots_v = clamped_knots(3, [0.3, 0.6, 0.7]), clamped_knots(2, [0.5])
    surface = TensorSpline(3, 2, knots_u, knots_v, rng.standard_normal((7, 4, 3)))
    u, v = np.linspace(0, 1, 40), np.linspace(0, 1, 9)
    grid = np.swapaxes(evaluate_grid(surface, u, v), 0, 1)
    along = fit_curves(rows_of(np.tile(u, (9, 1)), grid), knots_u, 3)
    columns = along.control_points[:, :, 0]
    across = fit_curves(Rows(v, np.zeros(9, dtype=int), columns, np.zeros((9, 7))), knots_v, 2)
    np.testing.assert_allclose(across.control_points[0], np.swapaxes(surface.control_points, 0, 1), atol=1e-10)


def test_centripetal_steps_are_roots_of_chords():
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 4, 0], [0, 0, 5], [0, 0, 5], [0, 0, 5]])
    row = np.array([0, 0, 0, 1, 1, 1])
    np.testing.assert_allclose(centripetal(points, row), [0, 1 / 3, 1, 0, 0.5, 1])


def test_columns_at_a_pole_do_not_count_for_common_parameters():
    moving = np.array([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    columns = np.stack([moving, np.zeros((3, 3))], axis=1)
    np.testing.assert_allclose(mean_centripetal(columns), [0, 1 / 3, 1])
    np.testing.assert_allclose(mean_centripetal(columns[:, 1:]), [0, 0.5, 1])


@pytest.mark.parametrize("knots_per_pass", [1, 8])
def test_knots_are_added_until_the_bound_holds(knots_per_pass):
    lines = wavy_lines(np.random.default_rng(1), sigma=0.0)
    rows = Rows(
        centripetal(lines.points, lines.line), lines.line, lines.points[:, None], np.zeros((len(lines.line), 1))
    )
    fit = refine_curves(rows, 3, 0.005, knots_per_pass).fit
    assert fit.errors.max() <= 0.005
    assert len(open_knots(3)) < len(fit.knots) < 40
    assert refine_curves(rows, 3, 10.0, 1).fit.knots.tolist() == open_knots(3).tolist()


def test_bound_below_the_noise_ends_where_the_data_bear_no_more_knots():
    rng = np.random.default_rng(2)
    u = np.sort(rng.random((3, 40)), axis=1)
    u[:, 0], u[:, -1] = 0.0, 1.0
    rows = rows_of(u, rng.standard_normal((3, 40, 3)))
    fit = refine_curves(rows, 3, 1e-3, 1).fit
    assert fit.errors.max() > 1e-3
    assert schoenberg_whitney(fit.knots, 3, rows)
    assert np.abs(fit.control_points).max() < 50


def test_allowance_for_noise_needs_fewer_knots():
    lines = wavy_lines(np.random.default_rng(3))
    paper = fit_scan_lines(lines, FitParams(bound_v=0.02, noise_margin=0.0, knots_per_pass=4))
    aware = fit_scan_lines(lines, FitParams(bound_v=0.02))
    assert aware.spline.control_points.size < paper.spline.control_points.size / 5
    assert aware.error_u <= FitParams().bound_u
    assert aware.error_v <= 0.02
    assert aware.residuals.rms < 2 * np.sqrt(3) * SIGMA


@pytest.mark.parametrize(
    ("u", "inner", "holds"),
    [
        ([0, 0.2, 0.4, 0.6, 0.8, 1], [0.5], True),
        ([0, 0.1, 0.2, 0.3, 0.4, 1], [0.5], True),
        ([0, 0.1, 0.2, 0.3, 0.4, 1], [0.5, 0.6], False),
        ([0, 0.3, 0.6, 1], [0.5], False),  # four points, five control points
    ],
)
def test_schoenberg_whitney_tells_a_regular_system(u, inner, holds):
    rows = rows_of(np.array([u], dtype=float), np.zeros((1, len(u), 3)))
    knots = clamped_knots(3, inner)
    assert schoenberg_whitney(knots, 3, rows) == holds
    if not holds:
        with pytest.raises(BsmapError, match="underdetermined"):
            fit_curves(rows, knots, 3)


def test_degree_across_is_lowered_for_few_scan_lines():
    fit = fit_scan_lines(wavy_lines(np.random.default_rng(4), lines=3), FitParams())
    assert fit.spline.degree_v == 2
    fit = fit_scan_lines(wavy_lines(np.random.default_rng(4), lines=2), FitParams())
    assert fit.spline.degree_v == 1
    assert fit.spline.control_points.shape[1] == 2


def test_single_scan_line_is_refused():
    with pytest.raises(BsmapError, match="needs 2 scan lines, here is 1"):
        fit_scan_lines(wavy_lines(np.random.default_rng(5), lines=1), FitParams())


def test_covariance_of_control_points_is_calibrated():
    """Over noise of known covariance, normalised squared errors of control points keep inside their chi-square band."""
    rng = np.random.default_rng(6)
    clean = wavy_lines(rng, lines=8, beams=80, sigma=0.0)
    roots = rng.uniform(0.2, 1.0, (len(clean.points), 1, 1)) * SIGMA * np.linalg.qr(rng.normal(size=(3, 3)))[0]
    roots = roots * np.array([1.0, 0.5, 0.2])
    lines = clean._replace(covariances=pack(roots @ np.swapaxes(roots, 1, 2)))
    fit = fit_scan_lines(lines, FitParams(bound_u=0.02))
    u, v, knots_u, knots_v = fit.u, fit.v, fit.spline.knots_u, fit.spline.knots_v

    def control_points(points):
        along = fit_curves(Rows(u, lines.line, points[:, None], np.zeros((len(u), 1))), knots_u, 3)
        columns = along.control_points[:, :, 0]
        row = Rows(v, np.zeros(len(v), dtype=int), columns, np.zeros(columns.shape[:2]))
        return np.swapaxes(fit_curves(row, knots_v, fit.spline.degree_v).control_points[0], 0, 1)

    truth = control_points(lines.points)
    runs = 240
    noise = [np.einsum("nij,nj->ni", roots, rng.standard_normal((len(u), 3))) for _ in range(runs)]
    errors = np.stack([control_points(lines.points + e) - truth for e in noise])
    blocks = unpack(fit.blocks)
    squared = np.einsum("rija,ijab,rijb->rij", errors, np.linalg.inv(blocks), errors)
    low, high = chi2.ppf([0.0005, 0.9995], 3 * runs)
    inside = (squared.sum(axis=0) > low) & (squared.sum(axis=0) < high)
    assert inside.mean() > 0.99
    assert squared.mean() == pytest.approx(3.0, rel=0.05)

    # On the surface, where the separable correlation between control points comes in.
    surface = as_surface(fit)
    at_u, at_v = rng.random((2, 50))
    predicted = sensor_covariance(surface, at_u, at_v)
    moved = np.stack([evaluate_surface(fit.spline._replace(control_points=e), at_u, at_v) for e in errors])
    ratio = np.einsum("rna,nab,rnb->rn", moved, np.linalg.inv(predicted), moved).mean()
    assert 2.4 < ratio < 3.6  # an approximation here: the points' noise is not equal


def as_surface(fit):
    covariance = SurfaceCovariance(fit.blocks, fit.correlation_u, fit.correlation_v, ())
    return BSplineSurface("s", ("s",), *fit.spline, covariance, Residuals(0, 0.0, 0.0, 0.0, 0.0))


def test_covariance_is_exact_in_full_for_equal_noise_and_parameters():
    """A straight tunnel under equal isotropic noise: C_P is (N'N)^-1 x (M'M)^-1 sigma^2, block by block."""
    t = np.linspace(0, np.pi, 60)
    arch = np.stack([2 * np.cos(t), np.zeros(60), 2 * np.sin(t)], axis=1)
    points = np.concatenate([arch + np.array([0, 0.1 * k, 0]) for k in range(7)])
    covariances = np.tile(pack(np.eye(3) * SIGMA**2), (420, 1))
    fit = fit_scan_lines(ScanLines(points, *np.divmod(np.arange(420), 60), covariances), FitParams(noise_margin=0.0))
    N = design_matrix(fit.spline.knots_u, 3, fit.u[:60])
    M = design_matrix(fit.spline.knots_v, 3, fit.v)
    u, v = np.random.default_rng(7).random((2, 20))
    rows_u, rows_v = design_matrix(fit.spline.knots_u, 3, u), design_matrix(fit.spline.knots_v, 3, v)
    along = np.einsum("ni,ij,nj->n", rows_u, np.linalg.inv(N.T @ N), rows_u)
    across = np.einsum("ni,ij,nj->n", rows_v, np.linalg.inv(M.T @ M), rows_v)
    wanted = SIGMA**2 * (along * across)[:, None, None] * np.eye(3)
    np.testing.assert_allclose(sensor_covariance(as_surface(fit), u, v), wanted, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 3, 5])
@pytest.mark.parametrize("knots_per_pass", [1, 7])
@pytest.mark.parametrize("seed", range(4))
def test_any_rows_are_refined_to_an_end(degree, knots_per_pass, seed):
    """Noise, jumps, gaps, coincident points, rows of unequal length: no crash, no wild curve."""
    rng = np.random.default_rng(seed)
    lengths = rng.integers(3 * degree + 3, 60, 5)
    row = np.repeat(np.arange(5), lengths)
    points = np.cumsum(rng.standard_normal((lengths.sum(), 3)) * 0.05, axis=0)
    points[rng.random(len(row)) < 0.1] += rng.choice([-2.0, 2.0])
    same = np.flatnonzero(rng.random(len(row) - 1) < 0.1)
    points[same + 1] = points[same]
    rows = Rows(centripetal(points, row), row, points[:, None], np.zeros((len(row), 1)))
    fit = refine_curves(rows, degree, 0.01, knots_per_pass).fit
    assert np.all(np.diff(fit.knots) >= 0)
    assert np.isfinite(fit.errors).all()
    size = np.ptp(points, axis=0).max()
    assert np.abs(fit.control_points - points.mean(axis=0)).max() < 30 * size
    assert fit.errors.max() < fit_curves(rows, open_knots(degree), degree).errors.max() * 1.5
