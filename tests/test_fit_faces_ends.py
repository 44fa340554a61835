"""Faces end where the scans show them to end, though corners stand between two scans."""

import numpy as np
import pytest
from face_scenes import simulated_place, turning_set

from bsmap_cli.evaluate import distance_to_mesh, surface_samples
from bsmap_cli.fit import divide
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.crossings import find_crossings
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.ends import doubtful_cells, find_ends, on_faces, within_ends
from bsmap_cli.fit.faces import fit_set
from bsmap_cli.fit.feet import tabulate
from bsmap_cli.fit.heights import offset
from bsmap_cli.fit.labels import feet_of_faces
from bsmap_cli.model import SurfaceMap
from bsmap_cli.simulate.geometry import carve, room, solid

BOX = room(0.0, 7.0, 0.0, 5.5, 0.0, 3.0)
CUPBOARD = solid(0.0, 0.6, 3.6, 5.5, 0.0, 2.0)
PILASTER = solid(3.0, 4.2, 0.0, 0.3, 0.0, 3.0)
NICHE = room(5.3, 6.2, 5.5, 5.65, 0.0, 2.05)
RADIATOR = solid(2.0, 5.0, 0.0, 0.15, 0.1, 0.8)
CAUSES = {
    "walls cross above the ceiling": [BOX],
    "floor reaches under a cupboard; its front rises over its top": [BOX, CUPBOARD],
    "floor cuts the corner of a pilaster": [BOX, PILASTER],
    "floor of a niche reaches into the wall beside it": [BOX, NICHE],
    "floor reaches into the wall under a radiator": [BOX, RADIATOR],
}


def faces_of(place):
    scans = np.arange(len(place.cloud.scan_poses))
    grid = make_grid(place.cloud, scans)
    return SurfaceMap(tuple(fit_set(place.cloud, scans, "set", grid, 0).surfaces), ())


STARTS = ((3.6, 2.9, 0.04), (4.4, 2.2, 1.6), (2.8, 1.9, 3.2))
TURNS = [pytest.param(c, s, id=f"{c}, start {k}") for c in CAUSES for k, s in enumerate(STARTS)]


@pytest.mark.parametrize(("cause", "start"), TURNS)
def test_no_sample_of_a_turn_strays_from_the_truth(cause, start):
    place = turning_set(carve(CAUSES[cause]), start)
    samples = surface_samples(faces_of(place), 0.02)
    distance = distance_to_mesh(samples, place.vertices, place.triangles)
    assert distance.max() < 0.025


@pytest.mark.parametrize("seed", [0, 7])
def test_no_sample_of_the_room_strays_and_what_was_seen_stays(seed):
    # In the seventh a beam of the rest lay between floor and chest: a cell cut the chest's corner, 97 mm deep.
    place = simulated_place("room", seed=seed)
    for movement in divide(place.cloud.scan_poses, 5.0):
        made = fit_set(place.cloud, movement.scans, "set", make_grid(place.cloud, movement.scans), 0)
        samples = surface_samples(SurfaceMap(tuple(made.surfaces), ()), 0.02)
        assert distance_to_mesh(samples, place.vertices, place.triangles).max() < 0.025


@pytest.fixture(scope="module")
def corner():
    place = turning_set(carve([BOX]), (3.6, 2.9, 0.04))
    grid = make_grid(place.cloud, np.arange(len(place.cloud.scan_poses)))
    faces = find_faces(grid)
    fields = [fitted.field for fitted in faces.fitted]
    crossings = find_crossings(grid, faces.labels, fields)
    grid = on_faces(grid, faces.labels, feet_of_faces(grid, faces.labels, fields))
    return grid, faces.labels, fields, crossings, find_ends(grid, faces.labels, crossings)


def test_crossings_moved_back_lie_on_all_three_faces(corner):
    grid, labels, fields, crossings, ends = corner
    settled = within_ends(grid, labels, tabulate(fields), crossings, ends)
    moved = np.flatnonzero(np.linalg.norm(settled.points - crossings.points, axis=1) > 0.0)
    assert len(moved)
    assert crossings.points[moved, 2].max() > 3.01
    assert settled.points[moved, 2].max() < 3.003
    for number in moved:
        both = [abs(offset(fields[f], settled.points[number : number + 1])[0][0]) for f in crossings.faces[number]]
        assert max(both) < 2e-4


def test_nothing_is_doubted_in_a_room_without_convex_corners(corner):
    grid, labels, fields, crossings, ends = corner
    assert not doubtful_cells(grid, labels, tabulate(fields), crossings, ends).any()


def test_ends_name_the_face_behind_the_border(corner):
    grid, labels, _, crossings, ends = corner
    row, column = np.nonzero(crossings.along >= 0)
    np.testing.assert_array_equal(ends.face[1, row, column], labels[row, column + 1])
    np.testing.assert_array_equal(ends.face[0, row, column + 1], labels[row, column])
    assert np.all(grid.hit[row, ends.last[1, row, column]])
