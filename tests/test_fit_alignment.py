"""Parameters that scan lines share, and knots left out: what each does is checked against the slow way."""

import numpy as np
import pytest
from face_scenes import corridor_set

from bsmap_cli.core.bspline import clamped_knots, evaluate_curve, evaluate_surface, inner_knots
from bsmap_cli.evaluate import distance_to_mesh
from bsmap_cli.fit.alignment import common_steps, moved, shared_centripetal
from bsmap_cli.fit.curves import Rows, as_one_row, centripetal, evaluate_rows, fit_curves
from bsmap_cli.fit.lines import gather_lines
from bsmap_cli.fit.movement import divide
from bsmap_cli.fit.refinement import _losses, refine_curves
from bsmap_cli.fit.surface import fit_scan_lines
from bsmap_cli.params import FitParams


def arches(rng, rows=6, beams=80, sigma=0.01):
    """Rows of noisy points on one bent line, each moved on."""
    t = np.linspace(0.0, np.pi, beams)
    line = np.stack([2 * np.cos(t), np.zeros(beams), (2 + 0.3 * np.sin(4 * t)) * np.sin(t)], axis=1)
    points = np.concatenate([line + np.array([0.0, 0.1 * k, 0.0]) for k in range(rows)])
    points += sigma * rng.standard_normal(points.shape)
    return points, *np.divmod(np.arange(rows * beams), beams)


def rows_of(points, row, place):
    u = shared_centripetal(points, row, place)
    return Rows(u, row, points[:, None], np.zeros((len(u), 1)), place)


def test_shared_parameters_are_the_mean_of_those_of_full_rows():
    points, row, beam = arches(np.random.default_rng(0))
    u = shared_centripetal(points, row, beam).reshape(6, -1)
    np.testing.assert_allclose(u, np.tile(centripetal(points, row).reshape(6, -1).mean(axis=0), (6, 1)), atol=1e-12)


def test_beams_keep_their_parameters_where_others_are_missing():
    points, row, beam = arches(np.random.default_rng(1), sigma=0.0)
    keep = np.random.default_rng(2).random(len(row)) < 0.7
    keep |= (beam == 0) | (beam == beam.max())
    u = shared_centripetal(points[keep], row[keep], beam[keep])
    first = {}
    assert all(first.setdefault(b, x) == pytest.approx(x, abs=1e-12) for b, x in zip(beam[keep], u, strict=True))
    # A chord over a gap is shorter than its parts, but not by much.
    np.testing.assert_allclose(u, centripetal(points, row)[keep], atol=0.02)


def test_coincident_points_get_equal_steps():
    u = shared_centripetal(np.zeros((5, 3)), np.zeros(5, dtype=int), np.array([0, 1, 2, 3, 5]))
    np.testing.assert_allclose(u, [0.0, 0.2, 0.4, 0.6, 1.0])


def test_rows_that_share_parameters_are_fitted_as_one():
    rows = rows_of(*arches(np.random.default_rng(3)))
    together = as_one_row(rows)
    assert together.n_rows == 1
    knots = clamped_knots(3, [0.2, 0.5, 0.6])
    apart = fit_curves(rows, knots, 3).control_points[:, :, 0]
    one = fit_curves(together, knots, 3).control_points[0]
    np.testing.assert_allclose(np.swapaxes(one, 0, 1), apart, atol=1e-10)
    ragged = Rows._make(field[1:] for field in rows)
    assert as_one_row(ragged) is ragged


def test_a_move_lowers_errors_and_keeps_order_and_ends():
    rows = rows_of(*arches(np.random.default_rng(4), sigma=0.03))
    knots = clamped_knots(3, [0.3, 0.5, 0.7])
    fit = fit_curves(rows, knots, 3)
    tangents = evaluate_rows(rows, knots, 3, fit.control_points, 1)
    after = moved(rows, common_steps(rows.place[:, None], tangents, fit.residuals))
    assert np.sum(fit_curves(after, knots, 3).errors ** 2) < np.sum(fit.errors**2)
    u = after.u.reshape(6, -1)
    np.testing.assert_array_equal(u, np.tile(u[0], (6, 1)))
    assert np.all(np.diff(u[0]) > 0.0)
    assert (u[0, 0], u[0, -1]) == (0.0, 1.0)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_loss_of_a_knot_is_what_a_fit_without_it_loses(degree):
    rows = rows_of(*arches(np.random.default_rng(5)))
    inner = np.array([0.15, 0.3, 0.55, 0.6, 0.8])
    fit = fit_curves(rows, clamped_knots(degree, inner), degree)
    without = [fit_curves(rows, clamped_knots(degree, np.delete(inner, k)), degree) for k in range(5)]
    growth = [np.sum(other.errors**2) - np.sum(fit.errors**2) for other in without]
    np.testing.assert_allclose(_losses(fit, degree), growth, rtol=1e-6)


def test_knots_that_a_known_spline_does_not_need_are_left_out():
    rng = np.random.default_rng(6)
    knots = clamped_knots(3, [0.25, 0.5, 0.75])
    u = np.linspace(0.0, 1.0, 200)
    data = evaluate_curve(knots, 3, rng.standard_normal((7, 3)), u)
    rows = Rows(u, np.zeros(200, dtype=int), data[:, None], np.zeros((200, 1)))
    found = refine_curves(rows, 3, 1e-3, 100)
    assert found.excess.max() <= 1e-3
    assert len(inner_knots(found.fit.knots, 3)) <= 9


def test_surface_of_a_corridor_needs_few_control_points():
    """One surface over corners, a recess and a pillar, at 10 mm noise (400 at 4.8 mm with own parameters)."""
    place = corridor_set(0.01, 0)
    lines = gather_lines(place.cloud, divide(place.cloud.scan_poses, 5.0)[0], 4)
    fit = fit_scan_lines(lines, FitParams())
    points = evaluate_surface(fit.spline, fit.u, fit.v[lines.line])
    truth = distance_to_mesh(points, place.vertices, place.triangles)
    assert fit.spline.control_points.size / 3 <= 300
    assert truth.mean() < 0.0036
    assert fit.error_u <= FitParams().bound_u
    assert fit.error_v <= FitParams().bound_v
