"""Projection on surfaces against brute force and known feet."""

import numpy as np
import pytest
from reference import brute_force_distance
from scipy.spatial import cKDTree

from bsmap_cli.core.bspline import TensorSpline, clamped_knots, evaluate_grid, evaluate_surface, open_knots
from bsmap_cli.core.projection import project
from bsmap_cli.core.sampling import sample_surface


def sheet(rng, nu=12, nv=9, roughness=0.05, degree=3):
    knots_u, knots_v = (clamped_knots(degree, np.arange(1, n - degree) / (n - degree)) for n in (nu, nv))
    x, y = np.meshgrid(np.linspace(0, 4, nu), np.linspace(0, 3, nv), indexing="ij")
    points = np.stack([x, y, 0.4 * np.sin(2 * x) * np.cos(y)], axis=2)
    return TensorSpline(degree, degree, knots_u, knots_v, points + roughness * rng.standard_normal(points.shape))


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_projection_is_as_near_as_brute_force(degree):
    rng = np.random.default_rng(degree)
    surface = sheet(rng, degree=degree)
    points = evaluate_surface(surface, *rng.random((2, 40))) + rng.normal(scale=0.3, size=(40, 3))
    samples = np.linspace(0, 1, 60)
    grid = evaluate_grid(surface, samples, samples)

    def evaluate(u, v):
        return evaluate_surface(surface, [u], [v])[0]

    found = project(surface, points)
    wanted = [brute_force_distance(evaluate, point, samples, samples, grid) for point in points]
    # Degree 1 has kinks at its knots, where no gradient method is exact; the twin is no better there.
    assert np.all(found.distance - wanted < (1e-3 if degree == 1 else 1e-6))


def test_points_of_the_surface_project_on_themselves():
    rng = np.random.default_rng(0)
    surface = sheet(rng)
    u, v = rng.random((2, 3000))
    points = evaluate_surface(surface, u, v)
    found = project(surface, points, sample_surface(surface))
    assert found.distance.max() < 1e-8
    assert found.on_surface.all()
    np.testing.assert_allclose(found.foot, points, atol=1e-8)


def test_foot_is_perpendicular_inside():
    rng = np.random.default_rng(1)
    surface = sheet(rng)
    points = evaluate_surface(surface, *rng.uniform(0.1, 0.9, (2, 500))) + np.array([0, 0, 0.1])
    found = project(surface, points)
    inside = (found.u > 0) & (found.u < 1) & (found.v > 0) & (found.v < 1)
    _, S_u, S_v = evaluate_surface(surface, found.u[inside], found.v[inside], 1)
    r = found.foot[inside] - points[inside]
    for tangent in (S_u, S_v):
        cosine = np.einsum("nk,nk->n", r, tangent) / np.linalg.norm(tangent, axis=1)
        assert np.abs(cosine).max() < 1e-7


def test_points_beyond_an_edge_are_off_the_surface():
    """Unit square in the plane z = 0: beyond an edge, over an edge, over the middle, beyond a corner."""
    corners = np.array([[[0.0, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0]]])
    surface = TensorSpline(1, 1, open_knots(1), open_knots(1), corners)
    points = np.array([[1.5, 0.5, 0.2], [1.0, 0.5, 0.2], [0.3, 0.6, -0.2], [-1.0, 2.0, 0.0]])
    found = project(surface, points)
    np.testing.assert_allclose(found.foot, [[1, 0.5, 0], [1, 0.5, 0], [0.3, 0.6, 0], [0, 1, 0]], atol=1e-9)
    np.testing.assert_allclose(found.distance, [np.hypot(0.5, 0.2), 0.2, 0.2, np.sqrt(2)], atol=1e-9)
    assert found.on_surface.tolist() == [False, True, True, False]


def test_pole_does_not_stop_the_projection():
    """A fan whose edge u = 0 is one point, as the zenith of a rotation set: S_v vanishes there."""
    angle = np.linspace(0, np.pi / 2, 5)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(5)], axis=1)
    control = np.stack([np.zeros((5, 3)), ring / 2, ring])
    surface = TensorSpline(2, 2, open_knots(2), clamped_knots(2, [0.3, 0.6]), control)
    found = project(surface, np.array([[0.0, 0.0, 0.4], [0.2, 0.2, 0.3], [-0.1, -0.1, 0.0]]))
    np.testing.assert_allclose(found.distance, [0.4, 0.3, np.hypot(0.1, 0.1)], atol=1e-8)


def test_nearer_sheet_of_a_fold_is_found():
    """Two sheets 0.2 m apart: points between them go to the nearer one, though its samples may be farther."""
    x = np.array([0.0, 1.5, 3.0, 3.0, 1.5, 0.0])
    z = np.array([0.0, 0.0, 0.0, 0.2, 0.2, 0.2])
    y = np.array([0.0, 1.0])
    control = np.stack(np.broadcast_arrays(x[:, None], y[None], z[:, None]), axis=2)
    surface = TensorSpline(1, 1, clamped_knots(1, [0.2, 0.4, 0.6, 0.8]), open_knots(1), control)
    rng = np.random.default_rng(2)
    points = np.column_stack([rng.uniform(0.1, 2.7, 500), rng.uniform(0.1, 0.9, 500), rng.uniform(0.0, 0.2, 500)])
    found = project(surface, points)
    np.testing.assert_allclose(found.distance, np.minimum(points[:, 2], 0.2 - points[:, 2]), atol=1e-8)


def test_crumpled_surface_hides_no_foot():
    """Valleys beside each other within a cell of the control net: none farther than a descent from any dense sample."""
    rng = np.random.default_rng(3)
    surface = sheet(rng, roughness=0.25)
    points = evaluate_surface(surface, *rng.random((2, 400))) + rng.normal(scale=0.02, size=(400, 3))
    grid = evaluate_grid(surface, *[np.linspace(0, 1, 700)] * 2)
    dense = cKDTree(grid.reshape(-1, 3)).query(points)[0]
    assert np.all(project(surface, points).distance <= dense + 1e-9)


def test_limit_changes_no_foot_within_it():
    rng = np.random.default_rng(4)
    surface = sheet(rng, roughness=0.1)
    points = evaluate_surface(surface, *rng.random((2, 2000))) + rng.normal(scale=0.1, size=(2000, 3))
    whole, limited = project(surface, points), project(surface, points, within=0.1)
    near = whole.distance <= 0.1
    assert 0.2 < near.mean() < 0.8
    np.testing.assert_allclose(limited.foot[near], whole.foot[near], atol=1e-8)
    assert np.all(limited.distance[~near] > 0.1)


def test_feet_on_a_concave_edge_are_exact():
    """Beyond the edge v = 0 of a quarter pipe and beyond its axis: the Hessian is indefinite, across the edge only."""
    arc = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    control = np.stack([np.column_stack([np.full(3, x), arc]) for x in (0.0, 0.3, 2.0)])
    surface = TensorSpline(2, 2, open_knots(2), open_knots(2), control)
    points = np.column_stack([np.linspace(0.2, 1.8, 50), np.full(50, -0.4), np.full(50, -0.9)])
    found = project(surface, points)
    _, _, S_v, _, _, S_vv = evaluate_surface(surface, found.u, found.v, 2)
    curvature = np.einsum("nk,nk->n", S_v, S_v) + np.einsum("nk,nk->n", found.foot - points, S_vv)
    assert np.all(found.v == 0.0)
    assert np.all(curvature < 0.0)
    np.testing.assert_allclose(found.foot[:, 0], points[:, 0], atol=1e-9)


def test_wrong_shape_is_refused():
    with pytest.raises(ValueError, match=r"shape \(3,\), wanted \(n, 3\)"):
        project(sheet(np.random.default_rng(0)), np.zeros(3))
