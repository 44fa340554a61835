"""Scans that touch a pillar's side belong to the wall behind it."""

from dataclasses import replace

import numpy as np
import pytest
from face_scenes import corridor_mesh, passing_set

from bsmap_cli.evaluate import distance_to_mesh
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.grazing import without_grazed_ends
from bsmap_cli.fit.heights import CylinderBase, least_knots
from bsmap_cli.fit.labels import feet_of_faces

SCANS = 200


@pytest.fixture(scope="module")
def passed():
    place = passing_set(corridor_mesh(), scans=SCANS, beams=541)
    grid = make_grid(place.cloud, np.arange(SCANS))
    return place, grid, find_faces(grid)


def pillar_of(faces):
    (number,) = (k for k, f in enumerate(faces.fitted) if isinstance(f.field.base, CylinderBase))
    return number


def test_a_pillar_keeps_its_shape_to_its_ends(passed):
    place, grid, faces = passed
    pillar = pillar_of(faces)
    field = faces.fitted[pillar].field
    assert field.knots.size <= least_knots(field.base, field.low, field.high).size + 2
    assert field.base.radius == pytest.approx(0.3, abs=0.003)
    feet = feet_of_faces(grid, faces.labels, [f.field for f in faces.fitted])
    error = distance_to_mesh(feet[pillar].points, place.vertices, place.triangles)
    assert error.max() < 0.004


def test_only_a_grazing_scan_that_the_wall_explains_is_given_to_it(passed):
    _, grid, faces = passed
    fields, pillar = [f.field for f in faces.fitted], pillar_of(faces)
    on_pillar = np.flatnonzero(np.count_nonzero(faces.labels == pillar, axis=1) > 100)
    beyond = on_pillar[-1] + 1
    wall = np.bincount(faces.labels[beyond, faces.labels[on_pillar[-1]] == pillar]).argmax()
    given = faces.labels == wall
    given[:beyond] = given[beyond + 1 :] = False
    # The first scan beyond the pillar, as if it had been taken for the pillar's; and one well on it.
    labels = faces.labels.copy()
    labels[given] = pillar
    after = without_grazed_ends(grid, labels, fields, faces.sigma)
    assert np.mean(after[given] == wall) > 0.95
    for row in on_pillar[2:-2]:
        assert np.array_equal(after[row], labels[row])
    # A wall that does not explain it does not get it.
    fields[wall] = replace(fields[wall], heights=fields[wall].heights + 0.05)
    assert np.all(without_grazed_ends(grid, labels, fields, faces.sigma)[given] == pillar)


def test_beams_in_a_line_are_no_face_that_stands_on_edge():
    # One beam of each scan on a side of the recess: any plane through their line would fit them.
    place = passing_set(corridor_mesh(), seed=1, scans=300, beams=271)
    grid = make_grid(place.cloud, np.arange(300))
    faces = find_faces(grid)
    assert np.mean(faces.labels[grid.hit] >= 0) > 0.995
    feet = feet_of_faces(grid, faces.labels, [f.field for f in faces.fitted])
    error = distance_to_mesh(np.concatenate([of.points for of in feet]), place.vertices, place.triangles)
    assert error.max() < 0.02
