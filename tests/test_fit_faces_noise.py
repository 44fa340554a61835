"""Faces at large noise: beams of narrow faces not in their neighbours, errors and covariance near the limit."""

from dataclasses import replace

import numpy as np
import pytest
from face_scenes import corridor_set

from bsmap_cli.evaluate import distance_to_mesh
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.heights import CylinderBase, PlaneBase, basis_matrix, evaluate, least_knots
from bsmap_cli.fit.labels import feet_of_faces
from bsmap_cli.fit.misses import find_misses, without_alike, without_slipped_ends

SIGMA = 0.03
SEEDS = (0, 3, 5)


@pytest.fixture(scope="module")
def found():
    """Of each seed the noise, the number of control points, errors (n,) of the feet and their variances (n,)."""
    out = []
    for seed in SEEDS:
        place = corridor_set(SIGMA, seed)
        grid = make_grid(place.cloud, np.arange(20))
        faces = find_faces(grid)
        errors, variances = [], []
        feet = feet_of_faces(grid, faces.labels, [f.field for f in faces.fitted])
        for fitted, of_face in zip(faces.fitted, feet, strict=True):
            errors.append(distance_to_mesh(of_face.points, place.vertices, place.triangles))
            N = basis_matrix(fitted.field.knots, of_face.uv)
            tilt = 1.0 + np.sum(evaluate(fitted.field, of_face.uv)[1] ** 2, axis=1)
            variances.append(np.sum((N @ np.linalg.inv(fitted.information)) * N, axis=1) / tilt)
        count = sum(fitted.field.knots.size for fitted in faces.fitted)
        out.append((faces.sigma, count, np.concatenate(errors), np.concatenate(variances)))
    return out


def test_error_at_30_mm_noise_is_that_of_the_control_points(found):
    for sigma, count, errors, _ in found:
        assert np.sqrt(np.mean(errors**2)) < 1.2 * sigma * np.sqrt(count / len(errors))


def test_covariance_at_30_mm_noise_holds_what_it_says(found):
    inside = np.mean([np.mean(errors**2 < 3.84 * variances) for _, _, errors, variances in found])
    assert 0.92 < inside < 0.99


def test_at_30_mm_noise_a_pillar_is_a_cylinder_all_the_same():
    for seed in SEEDS:
        faces = find_faces(make_grid(corridor_set(SIGMA, seed).cloud, np.arange(20)))
        bases = [f.field.base for f in faces.fitted]
        assert any(isinstance(base, CylinderBase) and abs(base.radius - 0.3) < 0.03 for base in bases)


def test_beams_that_miss_a_face_together_leave_it():
    grid = make_grid(corridor_set(0.01).cloud, np.arange(20))
    faces = find_faces(grid)
    fields = [f.field for f in faces.fitted]
    row, column = (int(k[len(k) // 2]) for k in np.nonzero(faces.labels == 0))
    moved = grid.points.copy()
    patch = np.s_[row - 2 : row + 3, column - 2 : column + 3]
    moved[patch] += 3.0 * faces.sigma * grid.directions[patch]
    grid = replace(grid, points=moved)
    labels = without_alike(grid, find_misses(grid, faces.labels, fields), faces.sigma)
    assert np.all(labels[row - 1 : row + 2, column - 1 : column + 2] == -1)
    assert np.count_nonzero(labels != faces.labels) < 40


def test_last_beam_that_misses_its_face_towards_the_jump_behind_it_leaves_it():
    grid = make_grid(corridor_set(0.01).cloud, np.arange(20))
    faces = find_faces(grid)
    fields = [f.field for f in faces.fitted]
    feet = feet_of_faces(grid, faces.labels, fields)
    points = grid.points.copy()
    for number, of_face in enumerate(feet):
        points[(faces.labels == number) & grid.hit] = of_face.points
    wall = faces.labels == np.argmax(np.bincount(faces.labels[faces.labels >= 0]))
    row, column = (int(k[len(k) // 2]) for k in np.nonzero(wall))
    # What lies behind the beam of half a metre more, in front of it, is a jump.
    points[row, column + 1] -= 0.5 * grid.directions[row, column + 1]
    labels = faces.labels.copy()
    labels[row, column + 1] = -1
    for miss, leaves in ((0.03, True), (-0.03, False), (0.01, False)):
        points[row, column] -= miss * grid.directions[row, column]
        moved = replace(grid, points=points)
        after = without_slipped_ends(moved, find_misses(moved, labels, fields), fields, faces.sigma)
        assert (after[row, column] == -1) == leaves
        points[row, column] += miss * grid.directions[row, column]
        assert np.count_nonzero(after != labels) == leaves


def test_beam_that_only_grazes_a_face_misses_it():
    grid = make_grid(corridor_set(0.01).cloud, np.arange(20))
    faces = find_faces(grid)
    normal = faces.fitted[0].field.base.axes[:, 2]
    row, column = (int(k[len(k) // 2]) for k in np.nonzero(faces.labels == 0))
    directions = grid.directions.copy()
    along = directions[row, column] - (directions[row, column] @ normal) * normal
    directions[row, column] = along / np.linalg.norm(along)
    misses = find_misses(replace(grid, directions=directions), faces.labels, [f.field for f in faces.fitted])
    assert np.isinf(misses.beyond[row, column])
    assert np.count_nonzero(np.isinf(misses.beyond)) == 1


def test_least_surface_over_a_cylinder_bears_an_error_of_its_centre():
    base, low = CylinderBase(np.zeros(2), 1.0, 0.0), np.array([-2.0, 0.0])
    knots = least_knots(base, low, np.array([1.0, 1.0]))
    assert (knots.degree_s, knots.degree_t, knots.shape) == (2, 1, (3, 2))
    assert least_knots(base, low, np.array([2.0, 1.0])).shape == (4, 2)
    assert least_knots(PlaneBase(np.zeros(3), np.eye(3)), low, -low).shape == (2, 2)
