"""Rims: borders at which the thing has an edge are told from shadows, from faces that turn away, and mere ends."""

import numpy as np
import pytest
from face_scenes import passing_set
from true_edges import distance_to_lines

from bsmap_cli.core.trims import rims_of
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.faces import fit_set
from bsmap_cli.fit.rims import LED, WIDEST, straightened
from bsmap_cli.simulate.geometry import arc, carve, join, room, solid, upright

HALL = room(-6.0, 8.0, -1.0, 3.0, 0.0, 2.6)
SHELF = solid(0.3, 1.7, 2.9, 3.0, 1.0, 1.5)


def rims_in(mesh, seed=0):
    place = passing_set(mesh, seed=seed)
    scans = np.arange(len(place.cloud.scan_poses))
    made = fit_set(place.cloud, scans, "set", make_grid(place.cloud, scans), 0)
    return [rim for surface in made.surfaces for rim in rims_of(surface)]


def samples(rims):
    """Places (n, 3) on rims, 1 cm apart."""
    parts = [np.zeros((0, 3))]
    for rim in rims:
        for start, end in zip(rim.points[:-1], rim.points[1:], strict=True):
            share = np.arange(max(1, int(np.linalg.norm(end - start) / 0.01)))[:, None] + 0.5
            parts.append(start + share / len(share) * (end - start))
    return np.concatenate(parts)


@pytest.mark.parametrize("seed", range(3))
def test_edges_of_a_box_on_a_wall_are_rims_of_its_front(seed):
    rims = rims_in(carve([HALL, SHELF]), seed)
    box = np.array([[x, 2.9, z] for x, z in ((0.3, 1.0), (1.7, 1.0), (1.7, 1.5), (0.3, 1.5), (0.3, 1.0))])
    found = samples(rims)
    off = distance_to_lines(found, [box, box + np.array([0.0, 0.1, 0.0])])
    assert np.quantile(off, 0.9) < WIDEST / 2.0
    assert off.max() < WIDEST
    level = np.column_stack([np.linspace(0.4, 1.6, 50), np.full(50, 2.9), np.full(50, 1.5)])
    assert np.mean(distance_to_lines(level, [rim.points for rim in rims]) < 0.025) > 0.9
    assert all(0.0 < rim.width <= WIDEST for rim in rims)


def test_the_shadow_that_a_plate_throws_on_a_wall_is_no_rim():
    rims = rims_in(carve([HALL, solid(0.3, 1.7, 2.2, 2.22, 0.8, 1.4)]))
    found = samples(rims)
    assert len(found)
    assert found[:, 1].max() < 2.5


def test_a_pillar_that_turns_away_has_no_rim():
    pillar = upright(arc((1.0, 2.2), 0.25, 0.0, 2 * np.pi, np.radians(2.0)), 0.0, 2.6)
    assert not len(samples(rims_in(join([carve([HALL]), pillar]))))


def test_a_bare_hall_has_no_rims():
    assert rims_in(carve([HALL])) == []


def test_brackets_of_a_straight_edge_give_two_vertices_near_it():
    rng = np.random.default_rng(0)
    x = np.linspace(0.0, 1.0, 26)
    line = straightened(np.column_stack([x, rng.uniform(-0.015, 0.015, 26)]), np.full(26, 0.04))
    assert line.shape == (2, 2)
    assert np.abs(line[:, 1]).max() < 0.01


def test_corners_of_rims_stay():
    x = np.linspace(0.0, 1.0, 21)[:, None]
    corner = np.concatenate([x * [1.0, 0.0], [1.0, 0.0] + x[1:] * [0.0, 1.0]])
    line = straightened(corner, np.full(41, 2.0 * LED))
    np.testing.assert_allclose(line, [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]], atol=1e-12)
