"""Beams that were lost: what lies between many neighbours of one face is no hole, a window is."""

import numpy as np
import pytest

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.division import find_faces
from bsmap_cli.fit.labels import enclosed, feet_of_faces
from bsmap_cli.fit.trimming import trim

SIGMA = 0.005
SHAPE = (30, 200)


def wall(hit: np.ndarray, seed: int = 0) -> BeamGrid:
    """A wall 2 m beside the way, by beams in planes across it; some of them do not return."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(-0.8, 0.8, SHAPE[1])
    directions = np.zeros((*SHAPE, 3))
    directions[..., 0], directions[..., 2] = np.cos(angles), np.sin(angles)
    origins = np.zeros((*SHAPE, 3))
    origins[..., 1] = 0.05 * np.arange(SHAPE[0])[:, None]
    ranges = 2.0 / np.cos(angles) + SIGMA * rng.normal(size=SHAPE)
    points = origins + directions * ranges[..., None]
    for part in (points, directions):
        part[~hit] = np.nan
    return BeamGrid(points, directions, np.where(hit, ranges, np.nan), angles, hit, SIGMA)


def loops_of(grid: BeamGrid) -> list[int]:
    """Of each face."""
    faces = find_faces(grid)
    found = feet_of_faces(grid, faces.labels, [fitted.field for fitted in faces.fitted])
    return [len(loops) for loops in trim(grid, faces, found).loops]


def test_lost_beams_make_no_holes():
    hit = np.random.default_rng(1).uniform(size=SHAPE) > 0.3
    assert len(loops_of(wall(hit))) == 1
    assert loops_of(wall(hit))[0] <= 3


def test_window_without_return_is_a_hole():
    hit = np.ones(SHAPE, dtype=bool)
    hit[10:18, 80:120] = False
    assert loops_of(wall(hit)) == [2]


def test_as_many_are_filled_as_told_where_both_scans_beside_show_the_face():
    hit = np.ones(SHAPE, dtype=bool)
    hit[2, 10:18] = hit[1, 25:31] = hit[2, 25:31] = hit[0, 5:10] = False
    grid = wall(hit)
    labels = np.where(hit, 0, -1)
    found = enclosed(grid, labels, 8)
    assert (found[2, 10:18] == 0).all()
    assert (found[1:3, 25:31] == -1).all()  # two scans
    assert (found[0, 5:10] == -1).all()  # none before
    np.testing.assert_array_equal(enclosed(grid, labels, 7), labels)
    labels[3, 12] = 1  # another face behind one of them
    assert (enclosed(grid, labels, 8)[2, 10:18] == -1).all()


@pytest.mark.parametrize("share", [0.02, 0.1])
def test_beams_too_few_for_any_face_are_the_rest(share):
    grid = wall(np.random.default_rng(0).uniform(size=SHAPE) < share)
    faces = find_faces(grid)
    assert not faces.fitted
    assert np.all(faces.labels == -1)
