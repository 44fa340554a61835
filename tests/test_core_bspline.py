"""B-spline basis, evaluation, refinement and covariance against slow twins and exact identities."""

from dataclasses import replace

import numpy as np
import pytest
from reference import naive_basis, naive_surface

from bsmap_cli.core.bspline import (
    TensorSpline,
    basis_functions,
    clamped_knots,
    design_matrix,
    evaluate_curve,
    evaluate_grid,
    evaluate_surface,
    insert_knots,
    open_knots,
    restrict,
)
from bsmap_cli.core.gaussian import pack, unpack
from bsmap_cli.core.uncertainty import (
    control_point_covariances,
    pose_covariance,
    pose_difference,
    sensor_covariance,
    surface_covariance,
)
from bsmap_cli.model import BSplineSurface, PosePart, Residuals, SurfaceCovariance

DEGREES = range(1, 6)


def some_knots(rng, degree, inner=6):
    """Knots with one inner knot of the highest multiplicity that leaves the spline continuous."""
    return clamped_knots(degree, np.concatenate([rng.uniform(0.01, 0.99, inner), [0.4] * degree]))


def some_surface(rng, degree_u=3, degree_v=2):
    knots_u, knots_v = some_knots(rng, degree_u), some_knots(rng, degree_v, 3)
    shape = (len(knots_u) - degree_u - 1, len(knots_v) - degree_v - 1, 3)
    return TensorSpline(degree_u, degree_v, knots_u, knots_v, rng.standard_normal(shape))


def uncertain_surface(rng):
    """Surface whose control points have random covariances, smoothly correlated, and two pose parts."""
    spline = some_surface(rng)
    nu, nv = spline.control_points.shape[:2]
    roots = rng.standard_normal((nu, nv, 3, 3))

    def correlation(n):
        return 0.5 ** np.abs(np.arange(n)[:, None] - np.arange(n))

    def pose_part(name, weight):
        root = rng.standard_normal((3, 3))
        return PosePart(name, rng.standard_normal(2), root @ root.T, weight)

    covariance = SurfaceCovariance(
        pack(roots @ np.swapaxes(roots, 2, 3)),
        correlation(nu),
        correlation(nv),
        (pose_part("a", 0.25), pose_part("b", 0.75)),
    )
    return BSplineSurface("s", ("a", "b"), *spline, covariance, Residuals(0, 0.0, 0.0, 0.0, 0.0))


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_equals_cox_de_boor_recursion(degree):
    rng = np.random.default_rng(degree)
    knots = some_knots(rng, degree)
    u = np.concatenate([[0.0, 0.4, 1.0], rng.random(30)])
    wanted = [[naive_basis(knots, degree, i, x) for i in range(len(knots) - degree - 1)] for x in u]
    np.testing.assert_allclose(design_matrix(knots, degree, u), wanted, atol=1e-14)


@pytest.mark.parametrize("degree", DEGREES)
def test_basis_functions_are_a_partition_of_unity(degree):
    rng = np.random.default_rng(degree)
    first, values = basis_functions(some_knots(rng, degree), degree, rng.random(1000), 2)
    assert values.shape == (1000, 3, degree + 1)
    assert first.shape == (1000,)
    assert values[:, 0].min() >= 0.0
    np.testing.assert_allclose(values[:, 0].sum(axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(values[:, 1].sum(axis=1), 0.0, atol=1e-9)


@pytest.mark.parametrize("degree", DEGREES)
def test_curve_derivatives_equal_central_differences(degree):
    rng = np.random.default_rng(degree)
    knots = clamped_knots(degree, np.arange(1, 8) / 8)
    points = rng.standard_normal((len(knots) - degree - 1, 3))
    # Away from the knots, where derivatives of low degrees jump.
    u, h = (rng.integers(0, 8, 50) + rng.uniform(0.1, 0.9, 50)) / 8, 1e-4
    values, first, second = evaluate_curve(knots, degree, points, u, 2)
    before, after = (evaluate_curve(knots, degree, points, u + s) for s in (-h, h))
    np.testing.assert_allclose(first, (after - before) / (2 * h), atol=1e-2)
    np.testing.assert_allclose(second, (after - 2 * values + before) / h**2, atol=1e-1)


def test_surface_equals_naive_double_sum():
    rng = np.random.default_rng(0)
    surface = some_surface(rng)
    u, v = rng.random((2, 20))
    u[:2], v[:2] = (0.0, 1.0), (1.0, 1.0)
    wanted = [naive_surface(surface, *uv) for uv in zip(u, v, strict=True)]
    np.testing.assert_allclose(evaluate_surface(surface, u, v), wanted, atol=1e-13)


def test_surface_derivatives_equal_central_differences():
    rng = np.random.default_rng(1)
    knots = clamped_knots(3, np.arange(1, 5) / 5)
    surface = TensorSpline(3, 3, knots, knots, rng.standard_normal((8, 8, 3)))
    u, v = rng.uniform(0.01, 0.99, (2, 200))
    h = 1e-5
    _, S_u, S_v, S_uu, S_uv, S_vv = evaluate_surface(surface, u, v, 2)
    left, right = (evaluate_surface(surface, u + s, v, 1) for s in (-h, h))
    down, up = (evaluate_surface(surface, u, v + s, 1) for s in (-h, h))
    for derivative, ahead, behind in (
        (S_u, right[0], left[0]),
        (S_v, up[0], down[0]),
        (S_uu, right[1], left[1]),
        (S_uv, up[1], down[1]),
        (S_vv, up[2], down[2]),
    ):
        np.testing.assert_allclose(derivative, (ahead - behind) / (2 * h), atol=2e-2, rtol=1e-4)


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("narrow", [0.01, 1e-6])
def test_polynomial_pieces_equal_basis_functions(degree, narrow):
    """Spans are found by a table, or by a search where one is too narrow for it."""
    rng = np.random.default_rng(degree)
    knots_u = clamped_knots(degree, [0.25, 0.5, 0.5 + narrow])
    knots_v = clamped_knots(2, [0.1, 0.7])
    surface = TensorSpline(degree, 2, knots_u, knots_v, rng.standard_normal((len(knots_u) - degree - 1, 5, 3)))
    u = np.concatenate([[0.0, 0.25, 0.5, 0.5 + narrow / 2, 0.5 + narrow, 1.0], rng.random(300)])
    v = np.concatenate([[0.1, 0.7, 1.0, 0.0, 1.0, 1.0], rng.random(300)])
    found = evaluate_surface(surface, u, v, 2)
    for (order_u, order_v), values in zip(((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2)), found, strict=True):
        along_u = design_matrix(knots_u, degree, u, order_u)
        along_v = design_matrix(knots_v, 2, v, order_v)
        wanted = np.einsum("ni,nj,ijd->nd", along_u, along_v, surface.control_points)
        np.testing.assert_allclose(values, wanted, atol=1e-12 * np.abs(along_u).max() * np.abs(along_v).max())


def test_grid_equals_scattered_points():
    rng = np.random.default_rng(2)
    surface = some_surface(rng)
    u, v = rng.random(7), rng.random(5)
    grid = evaluate_grid(surface, u, v)
    scattered = evaluate_surface(surface, np.repeat(u, 5), np.tile(v, 7))
    np.testing.assert_allclose(grid.reshape(-1, 3), scattered, atol=1e-13)


def test_evaluation_in_chunks_equals_evaluation_at_once():
    rng = np.random.default_rng(3)
    surface = some_surface(rng)
    u, v = rng.random((2, 5000))
    whole = evaluate_surface(surface, u, v, 1)
    np.testing.assert_array_equal(whole[:, 3000:3010], evaluate_surface(surface, u[3000:3010], v[3000:3010], 1))
    assert evaluate_surface(surface, u[:0], v[:0]).shape == (0, 3)


@pytest.mark.parametrize("degree", DEGREES)
def test_inserting_knots_keeps_the_curve_exactly(degree):
    rng = np.random.default_rng(degree)
    knots = some_knots(rng, degree)
    points = rng.standard_normal((len(knots) - degree - 1, 3))
    refined, matrix = insert_knots(knots, degree, [0.2, 0.2, 0.7][: degree + 1] if degree > 1 else [0.2, 0.7])
    u = np.linspace(0, 1, 501)
    same = evaluate_curve(refined, degree, matrix @ points, u)
    np.testing.assert_allclose(same, evaluate_curve(knots, degree, points, u), atol=1e-12)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0, atol=1e-14)
    assert matrix.min() >= -1e-15


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize(("a", "b"), [(0.13, 0.77), (0.0, 0.4), (0.4, 1.0), (0.0, 1.0)])
def test_restricting_keeps_the_piece_exactly(degree, a, b):
    rng = np.random.default_rng(degree)
    knots = some_knots(rng, degree)
    points = rng.standard_normal((len(knots) - degree - 1, 3))
    piece, matrix = restrict(knots, degree, a, b)
    t = np.linspace(0, 1, 301)
    # Just right of a knot of full multiplicity, the whole and the piece may round to its two sides.
    np.testing.assert_allclose(
        evaluate_curve(piece, degree, matrix @ points, t),
        evaluate_curve(knots, degree, points, np.clip(a + (b - a) * t, a, b)),
        atol=1e-12,
    )


def test_restricting_carries_the_covariance():
    """C of the piece's control points, by the matrix, gives the same covariance of points."""
    rng = np.random.default_rng(4)
    knots = some_knots(rng, 3)
    n = len(knots) - 4
    root = rng.standard_normal((n, n))
    piece, matrix = restrict(knots, 3, 0.2, 0.9)
    t = rng.random(20)
    N, N_piece = design_matrix(knots, 3, 0.2 + 0.7 * t), design_matrix(piece, 3, t)
    whole = N @ root @ root.T @ N.T
    np.testing.assert_allclose(N_piece @ matrix @ root @ root.T @ matrix.T @ N_piece.T, whole, atol=1e-11)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: clamped_knots(3, [0.0, 0.5]), "not inside"),
        (lambda: clamped_knots(2, [0.5, 0.5, 0.5]), "more than 2 times"),
        (lambda: restrict(open_knots(3), 3, 0.5, 0.5), "not an interval"),
        (lambda: evaluate_surface(some_surface(np.random.default_rng(0)), [0.5], [0.5, 0.6]), r"\(1,\) and \(2,\)"),
    ],
)
def test_mistakes_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_sensor_covariance_equals_dense_product():
    rng = np.random.default_rng(5)
    surface = uncertain_surface(rng)
    covariance = surface.covariance
    values, vectors = np.linalg.eigh(unpack(covariance.blocks))
    L = (vectors * np.sqrt(values)[..., None, :]) @ np.swapaxes(vectors, 2, 3)
    C = np.einsum("ijab,ik,jl,klcb->ijaklc", L, covariance.correlation_u, covariance.correlation_v, L)
    u, v = rng.random((2, 10))
    weights = np.einsum("ni,nj->nij", design_matrix(surface.knots_u, 3, u), design_matrix(surface.knots_v, 2, v))
    wanted = np.einsum("nij,ijaklc,nkl->nac", weights, C, weights)
    np.testing.assert_allclose(sensor_covariance(surface, u, v), wanted, atol=1e-12)


def test_pose_errors_of_one_trajectory_are_not_independent():
    """Against the joint covariance of all poses, written out."""
    rng = np.random.default_rng(8)
    modes, own = rng.normal(size=(4, 3, 2)) * 0.01, rng.normal(size=(4, 3, 3)) * 0.01
    trajectories, weights = ("t", "t", "u", "t"), (0.2, 0.3, 0.4, 0.1)
    parts, joint = [], np.zeros((12, 12))
    for a in range(4):
        for b in range(4):
            if trajectories[a] == trajectories[b]:
                joint[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] = modes[a] @ modes[b].T + (a == b) * own[a] @ own[a].T
        covariance = joint[3 * a : 3 * a + 3, 3 * a : 3 * a + 3]
        parts.append(PosePart(f"d{a}", rng.normal(size=2), covariance, weights[a], modes[a], trajectories[a]))

    def rigid(point, some):
        blocks = [
            p.weight * np.array([[1, 0, p.centre[1] - point[1]], [0, 1, point[0] - p.centre[0]], [0, 0, 0]])
            for p in some
        ]
        return np.concatenate(blocks, axis=1)

    points = rng.normal(size=(5, 3)) * 3
    for found, point in zip(pose_covariance(parts, points), points, strict=True):
        np.testing.assert_allclose(found, rigid(point, parts) @ joint @ rigid(point, parts).T, atol=1e-15)
    difference = pose_difference(parts[:3], parts[1:])
    wanted = [replace(part, weight=w) for part, w in zip(parts, (0.2, 0.0, 0.0, -0.1), strict=True)]
    for found, point in zip(pose_covariance(difference, points), points, strict=True):
        np.testing.assert_allclose(found, rigid(point, wanted) @ joint @ rigid(point, wanted).T, atol=1e-15)


def test_pose_parts_move_points_as_a_rigid_body():
    rng = np.random.default_rng(6)
    surface = uncertain_surface(rng)
    u, v = rng.random((2, 5))
    points = evaluate_surface(surface, u, v)
    wanted = np.zeros((5, 3, 3))
    for part in surface.covariance.pose:
        for k, (x, y, _) in enumerate(points):
            J = np.array([[1, 0, -(y - part.centre[1])], [0, 1, x - part.centre[0]], [0, 0, 0]])
            wanted[k] += part.weight**2 * J @ part.covariance @ J.T
    pose = surface_covariance(surface, u, v) - sensor_covariance(surface, u, v)
    np.testing.assert_allclose(pose, wanted, atol=1e-12)


def test_covariance_at_a_corner_is_that_of_its_control_point():
    surface = uncertain_surface(np.random.default_rng(7))
    corner = surface_covariance(surface, [0.0, 1.0], [0.0, 1.0])
    blocks = control_point_covariances(surface)
    np.testing.assert_allclose(corner, [blocks[0, 0], blocks[-1, -1]], atol=1e-12)
