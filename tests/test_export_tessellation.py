"""Meshes keep their tolerance, hold the knots, and turn their front to the sensor."""

from dataclasses import replace

import numpy as np
import pytest

from bsmap_cli.core.bspline import clamped_knots, evaluate_grid, evaluate_surface
from bsmap_cli.errors import ParameterError
from bsmap_cli.export.orientation import frontness, turn_to_sensor, turned, viewpoints
from bsmap_cli.export.tessellation import (
    Mesh,
    grid_parameters,
    second_derivative_bounds,
    tessellate,
    triangle_distance,
)
from bsmap_cli.model import BSplineSurface, PosePart, Residuals, SurfaceCovariance, SurfaceMap


def make_surface(control_points, degree_u=3, degree_v=3, inner_u=(), inner_v=(), name="s", parts=()):
    nu, nv = np.shape(control_points)[:2]
    covariance = SurfaceCovariance(np.zeros((nu, nv, 6)), np.eye(nu), np.eye(nv), tuple(parts))
    knots = clamped_knots(degree_u, inner_u), clamped_knots(degree_v, inner_v)
    points, residuals = np.asarray(control_points, dtype=float), Residuals(1, 0.0, 0.0, 0.0, 0.0)
    return BSplineSurface(name, ("d",), degree_u, degree_v, *knots, points, covariance, residuals)


def rough_surface(degree_u, degree_v, seed=0):
    """Bumpy square of 4 m with a knot of full multiplicity (a crease) in u."""
    inner_u, inner_v = np.r_[0.2, np.full(degree_u, 0.5), 0.8], (0.3, 0.7)
    nu, nv = len(inner_u) + degree_u + 1, len(inner_v) + degree_v + 1
    x, y = np.meshgrid(np.linspace(0, 4, nu), np.linspace(0, 4, nv), indexing="ij")
    z = np.random.default_rng(seed).normal(scale=0.3, size=(nu, nv))
    return make_surface(np.stack([x, y, z], 2), degree_u, degree_v, inner_u, inner_v)


def flat_surface(corners, **kwargs):
    """Bilinear surface between the corners of u, v = 00, 01, 10, 11."""
    return make_surface(np.reshape(corners, (2, 2, 3)), 1, 1, **kwargs)


def dense_distance(surface, u, v, n=20000):
    """Largest distance of random points of the surface to the two triangles of their cell."""
    at = np.random.default_rng(1).uniform(size=(2, n))
    i, j = (np.searchsorted(grid, x, "right") - 1 for grid, x in zip((u, v), at, strict=True))
    points = evaluate_grid(surface, u, v)
    p00, p10, p01, p11 = points[i, j], points[i + 1, j], points[i, j + 1], points[i + 1, j + 1]
    there = evaluate_surface(surface, *at)
    return np.minimum(triangle_distance(there, p00, p10, p11), triangle_distance(there, p00, p11, p01)).max()


@pytest.mark.parametrize(("degree_u", "degree_v"), [(1, 1), (1, 3), (2, 2), (3, 3), (4, 2)])
@pytest.mark.parametrize("tolerance", [0.05, 0.005])
def test_mesh_keeps_its_tolerance(degree_u, degree_v, tolerance):
    surface = rough_surface(degree_u, degree_v)
    u, v = grid_parameters(surface, tolerance)
    assert dense_distance(surface, u, v) <= tolerance


def test_tolerance_is_not_kept_by_wasting_points():
    surface = rough_surface(3, 3)
    u, v = grid_parameters(surface, 0.005)
    assert dense_distance(surface, u, v) > 0.005 / 2


def test_triangle_distance_agrees_with_dense_samples_of_the_triangle():
    rng = np.random.default_rng(3)
    weights = rng.dirichlet(np.ones(3) / 2, size=20000)
    for p, a, b, c in rng.normal(size=(20, 4, 3)):
        nearest = np.linalg.norm(weights @ np.stack([a, b, c]) - p, axis=1).min()
        assert triangle_distance(p, a, b, c) <= nearest
        assert triangle_distance(p, a, b, c) == pytest.approx(nearest, abs=0.02)


def test_distance_to_a_triangle_without_area_is_that_to_its_longest_side():
    a, b, c = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0]])
    assert triangle_distance(np.array([2.0, 1, 0]), a, b, c) == pytest.approx(1.0)
    assert triangle_distance(np.array([4.0, 0, 0]), a, b, c) == pytest.approx(1.0)


def test_flat_surface_is_not_divided_for_what_slides_inside_it():
    """Its parameters run unevenly: second derivatives, but no distance."""
    mesh = tessellate(make_surface([[[x, y, 0.0] for y in (0, 0.1, 0.5, 4)] for x in (0, 3, 3.5, 4)]), 0.001)
    assert len(mesh.triangles) == 2


def test_grid_holds_all_knots_so_that_creases_stay_sharp():
    surface = rough_surface(3, 2)
    u, v = grid_parameters(surface, 0.01)
    assert set(surface.knots_u) <= set(u)
    assert set(surface.knots_v) <= set(v)
    assert np.all(np.diff(u) > 0)
    assert np.all(np.diff(v) > 0)


def test_second_derivatives_stay_below_their_bounds():
    surface = rough_surface(3, 4)
    bounds = second_derivative_bounds(surface)
    u, v = np.random.default_rng(2).uniform(size=(2, 5000))
    i = np.searchsorted(np.unique(surface.knots_u), u, "right") - 1
    j = np.searchsorted(np.unique(surface.knots_v), v, "right") - 1
    derivatives = np.linalg.norm(evaluate_surface(surface, u, v, derivatives=2), axis=2)[3:]
    for bound, derivative in zip(bounds, derivatives, strict=True):
        assert np.all(derivative <= bound[i, j] * (1 + 1e-12))


def test_flat_surface_needs_two_triangles():
    mesh = tessellate(flat_surface([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]]), 1e-5)
    assert len(mesh.triangles) == 2
    assert len(mesh.vertices) == 4


def test_mesh_front_is_the_cross_product_of_the_partial_derivatives():
    mesh = tessellate(flat_surface([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]]), 0.01)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    assert np.all(np.cross(b - a, c - a)[:, 2] > 0)


def test_edge_that_shrinks_to_a_point_leaves_no_empty_triangles():
    mesh = tessellate(flat_surface([[0, 0, 0], [0, 0, 0], [1, 0, 0], [1, 1, 0]]), 0.01)
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert areas.min() > 1e-6
    assert areas.sum() == pytest.approx(0.5)
    assert set(mesh.triangles.ravel()) == set(range(len(mesh.vertices)))


def test_tolerance_that_needs_too_many_points_is_refused(monkeypatch):
    monkeypatch.setattr("bsmap_cli.export.tessellation.MOST_POINTS", 1000)
    with pytest.raises(ParameterError, match=r"tolerance of 1e-05 m needs more than 1000 points for surface s"):
        tessellate(rough_surface(3, 3), 1e-5)


def box_map(shape=(4.0, 6.0, 2.5)):
    """Floor, ceiling and four walls as six surfaces, fronts at random, seen from near one corner."""
    part = PosePart("d", np.array([0.7, 0.5]), np.zeros((3, 3)))
    surfaces = []
    for axis in range(3):
        for side in (0.0, 1.0):
            corners = np.insert(np.array([[0, 0], [0, 1], [1, 0], [1, 1]], dtype=float), axis, side, axis=1)
            surfaces.append(flat_surface(corners * shape, name=f"{axis}{side:.0f}", parts=[part]))
    return SurfaceMap(tuple(surfaces), ())


def test_room_faces_inwards():
    room = box_map()
    for surface in room.surfaces:
        mesh = turn_to_sensor(tessellate(surface, 0.01), surface.covariance.pose, viewpoints(room))
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
        inwards = np.array([2.0, 3.0, 1.25]) - a
        assert np.all(np.einsum("nd,nd->n", np.cross(b - a, c - a), inwards) > 0), surface.name


@pytest.mark.parametrize("side", [1, -1])
def test_side_decides_the_front_wherever_the_data_set_lies(side):
    part = PosePart("d", np.array([0.3, 0.3]), np.zeros((3, 3)))
    flat = flat_surface([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]], parts=[part])
    P, mesh = flat.control_points, tessellate(flat, 0.01)
    seen = side * np.cross(P[1, 0] - P[0, 0], P[0, 1] - P[0, 0])
    for height in (1.0, -1.0):
        front = turned(mesh, replace(flat, side=side), {"d": np.array([0.3, 0.3, height])})
        a, b, c = np.moveaxis(front.vertices[front.triangles], 1, 0)
        assert np.all(np.cross(b - a, c - a) @ seen > 0.0)


def test_heavier_data_set_decides_the_front():
    up, down = PosePart("up", np.zeros(2), np.zeros((3, 3)), 0.7), PosePart("down", np.zeros(2), np.zeros((3, 3)), 0.3)
    mesh = tessellate(flat_surface([[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0]]), 0.01)
    above, below = np.array([0.3, 0.3, 1.0]), np.array([0.3, 0.3, -1.0])
    assert turn_to_sensor(mesh, [up, down], {"up": above, "down": below}) is mesh
    turned = turn_to_sensor(mesh, [up, down], {"up": below, "down": above})
    assert frontness(turned, below) == pytest.approx(1.0)


def test_mesh_seen_edge_on_stays_as_it_is():
    mesh = Mesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    assert frontness(mesh, np.array([5.0, 5.0, 0.0])) == 0.0
    part = PosePart("d", np.zeros(2), np.zeros((3, 3)))
    assert turn_to_sensor(mesh, [part], {"d": np.array([5.0, 5.0, 0.0])}) is mesh
