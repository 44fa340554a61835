"""Beams beside creases belong to the face that they meet there."""

from dataclasses import replace

import numpy as np
import pytest
from face_scenes import corridor_set

from bsmap_cli.evaluate import distance_to_mesh
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.labels import _best_breaks, feet_of_faces, move_breaks
from bsmap_cli.fit.sides import closed_at_creases, on_their_sides


@pytest.fixture(scope="module")
def corridor():
    """Grid, labels, fields and noise of the corridor at 10 mm."""
    grid = make_grid(corridor_set().cloud, np.arange(20))
    faces = find_faces(grid)
    return grid, faces.labels, [fitted.field for fitted in faces.fitted], faces.sigma


def border(labels, scan):
    """Beam behind the last one of the longest run that a run of another face follows at once."""
    change = np.flatnonzero(
        (labels[scan, 1:] != labels[scan, :-1]) & (labels[scan, 1:] >= 0) & (labels[scan, :-1] >= 0)
    )
    return int(change[0]) + 1


def test_beams_beyond_a_crease_go_back(corridor):
    grid, labels, fields, sigma = corridor
    moved = labels.copy()
    for scan in range(20):
        at = border(labels, scan)
        step = 2 if scan % 2 else -2
        first, last = sorted((at, at + step))
        moved[scan, first:last] = labels[scan, at if step < 0 else at - 1]
    assert np.count_nonzero(moved != labels) == 40
    found = on_their_sides(grid, moved, fields, sigma)
    assert np.count_nonzero(found != labels) == 0


def test_what_lies_on_its_side_stays(corridor):
    grid, labels, fields, sigma = corridor
    np.testing.assert_array_equal(on_their_sides(grid, labels, fields, sigma), labels)


def test_a_beam_that_the_other_side_does_not_explain_stays(corridor):
    grid, labels, fields, sigma = corridor
    at = border(labels, 4)
    moved = labels.copy()
    moved[4, at] = labels[4, at - 1]
    points = grid.points.copy()
    points[4, at] += 0.5 * grid.directions[4, at]
    assert on_their_sides(replace(grid, points=points), moved, fields, sigma)[4, at] == moved[4, at]


@pytest.mark.parametrize(("before", "behind"), [(1, 0), (1, 1), (0, 2), (2, 1)])
def test_beams_of_the_rest_in_a_crease_come_to_the_face_on_their_side(corridor, before, behind):
    grid, labels, fields, sigma = corridor
    lost = labels.copy()
    for scan in range(20):
        at = border(labels, scan)
        lost[scan, at - before : at + behind] = -1
    np.testing.assert_array_equal(closed_at_creases(grid, lost, fields, sigma), labels)


def test_what_stands_in_a_crease_keeps_it_open(corridor):
    grid, labels, fields, sigma = corridor
    at = border(labels, 4)
    lost, points = labels.copy(), grid.points.copy()
    lost[4, at - 1 : at + 1] = -1
    points[4, at] -= 0.1 * grid.directions[4, at]
    np.testing.assert_array_equal(closed_at_creases(replace(grid, points=points), lost, fields, sigma), lost)


def test_a_tangle_of_beams_beside_a_crease_becomes_one_border(corridor):
    grid, labels, fields, sigma = corridor
    tangled = labels.copy()
    for scan in range(20):
        at = border(labels, scan)
        a, b = labels[scan, [at - 1, at]]
        tangled[scan, at - 4 : at + 4] = [a, b, b, a, a, b, a, b]
    found = move_breaks(grid, tangled, fields, sigma)
    assert np.mean(found == labels) > 0.999
    for scan in range(20):
        at = border(labels, scan)
        assert np.count_nonzero(np.diff(found[scan, at - 6 : at + 6])) == 1


def test_border_of_surfaces_that_touch_is_where_they_do_whatever_the_noise():
    rng = np.random.default_rng(0)
    noise = 0.01 * rng.standard_normal((50, 29))
    # One goes on in the other, 1 mm apart at the tenth beam; beyond it they leave each other slowly.
    apart = 0.001 + 0.0001 * (np.arange(29) - 10.0) ** 2
    before = np.arange(29) < 10
    found = _best_breaks(noise + ~before * apart, noise - before * apart, np.full(50, 13), 0.01)
    np.testing.assert_array_equal(found, 10)
    # Surfaces apart by more than the noise everywhere: the noise of single beams hardly matters.
    jump = np.where(np.arange(29) < 17, noise, noise + 0.2), np.where(np.arange(29) < 17, noise + 0.2, noise)
    assert np.all(_best_breaks(*jump, np.full(50, 13), 0.01) == 17)


def test_largest_error_at_30_mm_noise_is_that_of_the_noise():
    place = corridor_set(0.03, 8)
    grid = make_grid(place.cloud, np.arange(20))
    faces = find_faces(grid)
    feet = feet_of_faces(grid, faces.labels, [fitted.field for fitted in faces.fitted])
    points = np.concatenate([of.points for of in feet])
    assert distance_to_mesh(points, place.vertices, place.triangles).max() < 0.03


def test_runs_of_a_beam_at_the_first_and_the_last_beam_are_no_matter(corridor):
    grid, labels, fields, sigma = corridor
    edge = labels.copy()
    edge[:, 0], edge[:, -1] = labels[:, 1] + 1, labels[:, -2] + 1
    edge %= len(fields)
    assert np.mean(on_their_sides(grid, edge, fields, sigma)[:, 1:-1] == labels[:, 1:-1]) > 0.999
