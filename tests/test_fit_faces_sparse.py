"""Data sets of few scans far apart: planes between them that no beam supports."""

import numpy as np
import pytest
from face_scenes import corridor_mesh, corridor_set, turning_set

from bsmap_cli.evaluate import distance_to_mesh, surface_samples
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.claims import claim, directions_of
from bsmap_cli.fit.context import make_context
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.faces import fit_set
from bsmap_cli.fit.labels import feet_of_faces
from bsmap_cli.fit.pieces import find_pieces
from bsmap_cli.model import SurfaceMap

WALL = 2.2
"""y of the wall behind the pillar."""


@pytest.mark.parametrize("scans", [6, 8, 10])
def test_nothing_bridges_a_pillar_and_the_wall_beside_it(scans):
    place = corridor_set(scans=scans, beams=361)
    grid = make_grid(place.cloud, np.arange(scans))
    made = fit_set(place.cloud, np.arange(scans), "set", grid, 0)
    samples = surface_samples(SurfaceMap(tuple(made.surfaces), ()), 0.05)
    assert distance_to_mesh(samples, place.vertices, place.triangles).max() < 0.03
    assert len(made.surfaces) >= 5


def test_no_face_of_a_turn_runs_away_from_what_it_was_fitted_to():
    # A bent sheet ends freely: of what lies behind it, much is nearly as well explained by bending it on.
    place = turning_set(corridor_mesh(), np.array([1.9, 1.0, 0.0]))
    grid = make_grid(place.cloud, np.arange(19))
    faces = find_faces(grid)
    feet = feet_of_faces(grid, faces.labels, [fitted.field for fitted in faces.fitted])
    points = np.concatenate([of.points for of in feet])
    assert distance_to_mesh(points, place.vertices, place.triangles).max() < 0.03


@pytest.fixture(scope="module")
def six():
    """Context of six scans, of which the fourth and the fifth hit the pillar; pieces on that side in both halves."""
    place = corridor_set(scans=6, beams=361)
    context = make_context(grid := make_grid(place.cloud, np.arange(6)), find_pieces(grid))
    middles = np.array([context.blocks_of([k]).points.mean(axis=0) for k in range(len(context.pieces.row))])
    across = (middles[:, 1] > 1.85) & (middles[:, 2] > 0.5) & (middles[:, 2] < 2.0)
    return context, [np.flatnonzero(across & (context.pieces.row // 3 == k)).tolist() for k in (0, 1)]


def numbered(context, regions):
    owner = np.full(len(context.pieces.row), -1)
    for number, members in enumerate(regions):
        owner[members] = number
    return owner


def test_the_wall_claims_its_scan_from_a_plane_by_chance(six):
    context, (wall, chance) = six
    owner = numbered(context, [wall, chance])
    found = claim(context, [wall, chance], owner)
    assert [sorted(members) for members in found] == [sorted(wall + chance[-1:])]
    np.testing.assert_array_equal(owner, numbered(context, found))


def test_the_wall_claims_a_free_scan_and_leaves_the_pillar(six):
    context, (wall, chance) = six
    found = claim(context, [wall], numbered(context, [wall]))
    assert sorted(found[0]) == sorted(wall + chance[-1:])


def test_a_region_explained_as_a_whole_is_left_to_be_joined(six):
    context, (wall, chance) = six
    regions = [wall, chance[-1:]]
    assert claim(context, regions, numbered(context, regions)) == regions


def test_directions_are_those_of_planes_of_many_scans_and_what_is_square_to_two():
    place = corridor_set(scans=10, beams=361)
    context = make_context(grid := make_grid(place.cloud, np.arange(10)), find_pieces(grid))
    middles = np.array([context.blocks_of([k]).points.mean(axis=0) for k in range(len(context.pieces.row))])
    floor = np.flatnonzero(np.abs(middles[:, 2]) < 0.05)
    wall = np.flatnonzero((np.abs(middles[:, 1] - WALL) < 0.05) & (np.abs(middles[:, 2] - 1.3) < 1.0))
    bowed = np.flatnonzero((middles[:, 1] < -0.15) & (np.abs(middles[:, 2] - 1.3) < 1.0))
    few = wall[context.pieces.row[wall] < 4]
    found = directions_of(context, [floor.tolist(), wall.tolist(), bowed.tolist()])
    np.testing.assert_allclose(np.abs(found), [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]], atol=5e-3)
    assert len(directions_of(context, [floor.tolist(), few.tolist(), bowed.tolist()])) == 1
