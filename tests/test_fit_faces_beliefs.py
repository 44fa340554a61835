"""Faces that miss their beams by more than noise are not believed; faces tell how large the noise is."""

import numpy as np
import pytest
from face_scenes import corridor_set, egg, passing_set, simulated_place

from bsmap_cli.fit import misses as misses_module
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.beliefs import believed, scale_left
from bsmap_cli.fit.division import _fit, blocks_of_faces, find_faces
from bsmap_cli.fit.misses import ALIKE, _window_sums, find_misses, without_alike


@pytest.fixture(scope="module")
def corridor():
    """Grid, faces and how the beams miss them."""
    grid = make_grid(corridor_set().cloud, np.arange(20))
    faces = find_faces(grid)
    return grid, faces, find_misses(grid, faces.labels, [f.field for f in faces.fitted])


def test_faces_that_explain_their_beams_are_believed(corridor):
    grid, faces, misses = corridor
    final = believed(grid, misses, faces.sigma, faces.sigma)
    assert set(np.unique(final[grid.hit])) >= set(range(len(faces.fitted)))
    assert np.mean(final[grid.hit] == faces.labels[grid.hit]) > 0.999


def test_a_face_that_bridges_a_step_is_not(corridor):
    """Two sigma to either side: hardly a beam is an outlier."""
    grid, faces, misses = corridor
    number = 2
    step = np.where(np.indices(misses.labels.shape)[0] < 10, 2.0, -2.0) * faces.sigma
    bridged = misses._replace(beyond=misses.beyond + np.where(misses.labels == number, step, 0.0))
    final = believed(grid, bridged, faces.sigma, faces.sigma)
    assert not np.any(final == number)
    assert np.mean(final[grid.hit] == faces.labels[grid.hit]) > 0.99 - np.mean(faces.labels[grid.hit] == number)


def test_a_face_denied_by_many_beams_is_not_believed(corridor):
    grid, faces, misses = corridor
    away = (np.indices(misses.labels.shape)[1] % 5 == 0) & (misses.labels == 2)
    denied = misses._replace(beyond=np.where(away, 1.0, misses.beyond))
    assert not np.any(believed(grid, denied, faces.sigma, faces.sigma) == 2)


@pytest.mark.parametrize(
    ("place", "scans"),
    [(lambda: simulated_place("room", 1), np.arange(20, 40)), (lambda: passing_set(egg()), np.arange(20))],
)
def test_faces_tell_the_noise_where_corners_and_bends_seem_noise(place, scans):
    grid = make_grid(place().cloud, scans)
    assert find_faces(grid).sigma == pytest.approx(0.01, rel=0.05)


def test_faces_that_fit_badly_tell_nothing_of_the_noise(corridor):
    grid, faces, _ = corridor
    blocks = blocks_of_faces(grid, faces.labels)
    fitted = [_fit(grid, faces.labels == k, of_face, 2 * faces.sigma) for k, of_face in enumerate(blocks)]
    assert scale_left(fitted, blocks) == pytest.approx(0.5, rel=0.05)
    spoiled = [one._replace(criterion=100.0 * one.criterion) if k == 1 else one for k, one in enumerate(fitted)]
    assert scale_left(spoiled, blocks) == pytest.approx(0.5, rel=0.05)
    assert scale_left([one._replace(criterion=10.0 * one.criterion) for one in fitted], blocks) == 1.0
    assert scale_left([], []) == 1.0


def test_sums_of_neighbourhoods_are_those_of_beams_of_one_face():
    """Slow twin."""
    rng = np.random.default_rng(0)
    own = np.repeat(rng.integers(-1, 3, (9, 12)), 3, axis=1)
    values = rng.normal(size=own.shape)
    for up, side in ALIKE:
        total, count = _window_sums(own, values, (up, side))
        for row, column in np.ndindex(own.shape):
            rows = slice(max(0, row - up // 2), row + up // 2 + 1)
            columns = slice(max(0, column - side // 2), column + side // 2 + 1)
            same = own[rows, columns] == own[row, column]
            if own[row, column] >= 0:
                assert count[row, column] == np.count_nonzero(same)
                assert total[row, column] == pytest.approx(values[rows, columns][same].sum())


def test_neighbourhoods_are_the_same_however_many_scans_are_worked_on_at_once(corridor, monkeypatch):
    grid, faces, misses = corridor
    whole = without_alike(grid, misses, 0.5 * faces.sigma)
    assert np.count_nonzero(whole != misses.labels) > 10
    monkeypatch.setattr(misses_module, "CHUNK", 3 * grid.hit.shape[1])
    np.testing.assert_array_equal(without_alike(grid, misses, 0.5 * faces.sigma), whole)
