"""Faces of vaults, which are neither planes nor vertical cylinders."""

import numpy as np
import pytest
from face_scenes import barrel_vault, dome, egg, passing_set, ring, tunnel, turning_set

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.evaluate import distance_to_mesh
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.heights import Bulge, CylinderBase, basis_matrix, evaluate
from bsmap_cli.fit.labels import feet_of_faces
from bsmap_cli.fit.lowmodels import fit_axis, fit_sphere_frame, sphere_axes
from bsmap_cli.fit.pieces import find_pieces
from bsmap_cli.fit.surfaces import spline_of


@pytest.mark.parametrize("scene", [barrel_vault, tunnel, dome])
@pytest.mark.parametrize("turning", [False, True], ids=["translation", "rotation"])
def test_vaults_are_covered_at_their_own_noise(scene, turning):
    place = turning_set(scene(), np.array([1.0, 1.2, 0.3])) if turning else passing_set(scene())
    grid = make_grid(place.cloud, np.unique(place.cloud.scan_index))
    faces = find_faces(grid)
    assert np.mean(faces.labels[grid.hit] >= 0) > 0.98
    assert faces.sigma < 0.0115
    feet = feet_of_faces(grid, faces.labels, [f.field for f in faces.fitted])
    error = distance_to_mesh(np.concatenate([of.points for of in feet]), place.vertices, place.triangles)
    assert np.sqrt(np.mean(error**2)) < 0.002


@pytest.mark.parametrize("turning", [False, True], ids=["translation", "rotation"])
def test_a_tunnel_is_one_cylinder_with_a_level_axis(turning):
    place = turning_set(tunnel(), np.array([1.0, 1.2, 0.3])) if turning else passing_set(tunnel())
    grid = make_grid(place.cloud, np.unique(place.cloud.scan_index))
    faces = find_faces(grid)
    assert len(faces.fitted) == 2
    (round_one,) = (k for k, f in enumerate(faces.fitted) if isinstance(f.field.base, CylinderBase))
    field, information = faces.fitted[round_one][:2]
    assert field.base.radius == pytest.approx(2.0, abs=0.005)
    np.testing.assert_allclose(np.abs(field.base.upright[:, 2]), [1.0, 0.0, 0.0], atol=0.005)
    assert field.knots.size <= 12
    feet = feet_of_faces(grid, faces.labels, [f.field for f in faces.fitted])[round_one]
    error = distance_to_mesh(feet.points, place.vertices, place.triangles)
    assert np.sqrt(np.mean(error**2)) < 0.0006
    N = basis_matrix(field.knots, feet.uv)
    variance = np.sum((N @ np.linalg.inv(information)) * N, axis=1)
    assert np.mean(error**2 < 3.84 * variance) > 0.9


def test_axis_of_a_cylinder_is_found_from_any_part_of_it():
    rng = np.random.default_rng(0)
    for _ in range(10):
        axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        angle, along = rng.uniform(0.0, rng.uniform(1.5, 6.0), 400), rng.uniform(0.0, rng.uniform(1.0, 8.0), 400)
        outwards = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(400)])
        points = 1.5 * outwards + along[:, None] * [0.0, 0.0, 1.0] + 0.003 * rng.normal(size=(400, 3))
        ones = np.ones(400)
        blocks = Blocks(points @ axes.T, outwards @ axes.T, ones, ones.astype(int), ones, ones.astype(int))
        found = fit_axis(blocks)
        assert abs(found[:, 2] @ axes[:, 2]) > np.cos(0.01)


def test_conics_that_turn_far_are_divided():
    grid = make_grid(passing_set(tunnel()).cloud, np.arange(20))
    pieces = find_pieces(grid)
    around = np.unwrap(np.arctan2(grid.points[:, :, 2] - 1.0, grid.points[:, :, 1] - 1.0), axis=1)
    turn = np.abs(around[pieces.row, pieces.stop - 1] - around[pieces.row, pieces.start])
    assert pieces.curved.sum() >= 4 * 20
    assert turn[pieces.curved].max() < np.radians(75.0)


@pytest.mark.parametrize("turning", [False, True], ids=["translation", "rotation"])
def test_a_dome_is_one_face_at_its_own_noise_with_an_honest_covariance(turning):
    place = turning_set(dome(), np.array([1.0, 1.2, 0.3])) if turning else passing_set(dome())
    scans = np.unique(place.cloud.scan_index)
    grid = make_grid(place.cloud, scans)
    faces = find_faces(grid)
    assert len(faces.fitted) == 2
    (round_one,) = (k for k, f in enumerate(faces.fitted) if isinstance(f.field.base, CylinderBase))
    field, information = faces.fitted[round_one][:2]
    assert field.base.bulge.radius == pytest.approx(3.0, abs=0.005)
    feet = feet_of_faces(grid, faces.labels, [f.field for f in faces.fitted])[round_one]
    error = distance_to_mesh(feet.points, place.vertices, place.triangles)
    assert np.sqrt(np.mean(error**2)) < 0.0006
    N = basis_matrix(field.knots, feet.uv)
    tilt = 1.0 + np.sum(evaluate(field, feet.uv)[1] ** 2, axis=1)
    variance = np.sum((N @ np.linalg.inv(information)) * N, axis=1) / tilt
    assert np.mean(error**2 < 3.84 * variance) > 0.9
    spline, covariance = spline_of(faces.fitted[round_one], ())
    points = evaluate_surface(spline, feet.uv[:, 0], feet.uv[:, 1])
    assert np.abs(np.linalg.norm(points - feet.points, axis=1)).max() < 0.001
    assert covariance.matrix.shape == (spline.control_points[..., 0].size,) * 2


def test_a_sphere_over_a_cylinder_is_one():
    bulge = Bulge(0.3, 2.0)
    t = np.linspace(-1.5, 2.1, 50)
    height, slope = bulge.over(t)
    np.testing.assert_allclose((2.0 + height) ** 2 + (t - 0.3) ** 2, 4.0)
    step = 1e-6
    np.testing.assert_allclose((bulge.over(t + step)[0] - bulge.over(t - step)[0]) / (2 * step), slope, atol=1e-6)
    # Beyond the pole it goes on straight.
    far, steep = bulge.over(np.array([2.4, 2.9]))
    assert far[1] - far[0] == pytest.approx(0.5 * steep[0])


def test_a_sphere_is_found_from_a_part_of_it_and_its_axis_is_away_from_it():
    rng = np.random.default_rng(0)
    for _ in range(5):
        centre, radius = rng.normal(size=3), rng.uniform(0.3, 4.0)
        n = rng.normal(size=(600, 3))
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        pole = rng.normal(size=3)
        pole /= np.linalg.norm(pole)
        n = n[np.abs(n @ pole) < 0.6]
        ones = np.ones(len(n))
        points = centre + radius * n + 0.003 * rng.normal(size=n.shape)
        blocks = Blocks(points, n, ones, ones.astype(int), ones, ones.astype(int))
        found = fit_sphere_frame(blocks)
        np.testing.assert_allclose(found.centre, centre, atol=0.002)
        assert found.radius == pytest.approx(radius, abs=0.002)
        assert abs(sphere_axes(blocks, found)[:, 2] @ pole) > 0.97
    everywhere = rng.normal(size=(600, 3))
    everywhere /= np.linalg.norm(everywhere, axis=1, keepdims=True)
    ones = np.ones(600)
    all_around = Blocks(everywhere, everywhere, ones, ones.astype(int), ones, ones.astype(int))
    assert sphere_axes(all_around, fit_sphere_frame(all_around)) is None


@pytest.mark.parametrize(("scene", "share"), [(egg, 0.9), (ring, 0.87)])
def test_covariance_holds_where_faces_bend_both_ways(scene, share):
    place = passing_set(scene())
    grid = make_grid(place.cloud, np.arange(20))
    faces = find_faces(grid)
    assert np.mean(faces.labels[grid.hit] >= 0) > 0.998
    inside = []
    for fitted, feet in zip(
        faces.fitted, feet_of_faces(grid, faces.labels, [f.field for f in faces.fitted]), strict=True
    ):
        error = distance_to_mesh(feet.points, place.vertices, place.triangles)
        N = basis_matrix(fitted.field.knots, feet.uv)
        tilt = 1.0 + np.sum(evaluate(fitted.field, feet.uv)[1] ** 2, axis=1)
        variance = np.sum((N @ np.linalg.inv(fitted.information)) * N, axis=1) / tilt
        assert np.sqrt(np.mean(error**2)) < 0.0025
        inside.append(error**2 < 3.84 * variance)
    assert np.mean(np.concatenate(inside)) > share
