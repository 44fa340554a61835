"""Faces of vaults, which are neither planes nor vertical cylinders."""

import numpy as np
import pytest
from face_scenes import barrel_vault, dome, passing_set, tunnel, turning_set

from bsmap_cli.evaluate import distance_to_mesh
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.labels import feet_of_faces
from bsmap_cli.fit.pieces import find_pieces


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


def test_conics_that_turn_far_are_divided():
    grid = make_grid(passing_set(tunnel()).cloud, np.arange(20))
    pieces = find_pieces(grid)
    around = np.unwrap(np.arctan2(grid.points[:, :, 2] - 1.0, grid.points[:, :, 1] - 1.0), axis=1)
    turn = np.abs(around[pieces.row, pieces.stop - 1] - around[pieces.row, pieces.start])
    assert pieces.curved.sum() >= 4 * 20
    assert turn[pieces.curved].max() < np.radians(75.0)
