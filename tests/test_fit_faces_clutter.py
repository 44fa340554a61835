"""Small planes among the beams of no face: found in clutter, not made of it."""

import numpy as np
import pytest

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.clutter import FEWEST, NOISY, find_planes
from bsmap_cli.fit.heights import Knots, PlaneBase
from bsmap_cli.fit.selection import fit_heights
from bsmap_cli.fit.smoothness import smoothness

SIGMA = 0.01
SHAPE = 20, 60


def grid_of(depth, seed):
    """Beams that look along x, 5 cm apart, to depths (m, n) with noise."""
    y, z = np.meshgrid(0.05 * np.arange(SHAPE[0]), 0.05 * np.arange(SHAPE[1]), indexing="ij")
    noisy = depth + SIGMA * np.random.default_rng(seed).standard_normal(SHAPE)
    directions = np.zeros((*SHAPE, 3))
    directions[..., 0] = 1.0
    points = np.stack([noisy, y, z], axis=2)
    return BeamGrid(points, directions, noisy, 0.01 * np.arange(SHAPE[1]), np.ones(SHAPE, dtype=bool), SIGMA)


def clutter(seed):
    return np.random.default_rng(seed).uniform(2.0, 4.0, SHAPE)


def test_narrow_planes_in_clutter_are_found_whole_and_apart():
    # Two beams wide, and slanted: too narrow for a piece of a scan line.
    strips = (slice(2, 18), slice(10, 12)), (slice(5, 8), slice(30, 42)), (slice(10, 16), slice(45, 50))
    y, z = np.meshgrid(0.05 * np.arange(SHAPE[0]), 0.05 * np.arange(SHAPE[1]), indexing="ij")
    found = 0
    for seed in range(10):
        depth = clutter(seed)
        for strip in strips:
            depth[strip] = 3.0 + 0.3 * y[strip] - 0.2 * z[strip]
        labels = find_planes(grid_of(depth, seed), np.full(SHAPE, -1), SIGMA)
        for strip in strips:
            number, count = np.unique(labels[strip], return_counts=True)
            found += number[np.argmax(count)] >= 0 and count.max() > 0.9 * labels[strip].size
        assert np.count_nonzero(labels >= 0) < 1.15 * sum(labels[strip].size for strip in strips)
    # Of few beams one in fifty is noisier than what is believed.
    assert found >= 28


@pytest.mark.parametrize("seed", range(5))
def test_clutter_alone_gives_no_plane(seed):
    assert np.all(find_planes(grid_of(clutter(seed), seed), np.full(SHAPE, -1), SIGMA) < 0)


def test_a_surface_rougher_than_the_noise_is_no_plane():
    rough = 3.0 + 3.0 * SIGMA * np.random.default_rng(0).standard_normal(SHAPE)
    labels = find_planes(grid_of(rough, 1), np.full(SHAPE, -1), SIGMA)
    assert np.mean(labels >= 0) < 0.1


def test_beams_of_faces_stay_and_planes_have_numbers_of_their_own():
    grid = grid_of(np.full(SHAPE, 3.0), 0)
    before = np.full(SHAPE, -1)
    before[:, :30] = 4
    after = find_planes(grid, before, SIGMA)
    np.testing.assert_array_equal(after[:, :30], 4)
    number, count = np.unique(after[:, 30:], return_counts=True)
    assert count[number == 5] > 0.95 * after[:, 30:].size
    assert np.all(count[number >= 0] >= FEWEST)
    of_plane = grid.ranges[after == 5]
    assert of_plane.std() < NOISY * SIGMA


def test_heights_without_data_do_not_swing_farther_than_their_spans():
    rng = np.random.default_rng(0)
    s, t = rng.uniform(0.0, 0.2, (2, 4000))
    # Nothing in two corners; knots as a wavy surface asks for.
    seen = (np.hypot(s, t) > 0.08) & (np.hypot(s - 0.2, t - 0.2) > 0.08)
    s, t = s[seen], t[seen]
    points = np.column_stack([s, t, 0.01 * np.sin(60.0 * s) * np.cos(50.0 * t) + 0.005 * rng.standard_normal(len(s))])
    up, one = np.tile([0.0, 0.0, -1.0], (len(s), 1)), np.ones(len(s))
    blocks = Blocks(points, up, one, np.arange(len(s)), one, np.arange(len(s)))
    fitted = fit_heights(blocks, PlaneBase(np.zeros(3), np.eye(3)), np.zeros(2), np.full(2, 0.2), 0.005)
    assert fitted.field.knots.size > 20
    assert np.abs(fitted.field.heights).max() < 0.1


def test_smoothness_by_its_definition():
    knots = Knots(2, 1, np.array([0.0, 0, 0, 0.5, 1, 1, 1]), np.array([0.0, 0, 0.5, 1, 1]))
    heights = np.random.default_rng(0).standard_normal(knots.shape)
    along_s, along_t = np.diff(heights, 2, axis=0), np.diff(heights, 2, axis=1)
    for size, loose in ((None, (0.3, 0.3)), (np.array([0.2, 2.0]), (0.1, 0.3))):
        expected = np.sum(along_s**2) / loose[0] ** 2 + np.sum(along_t**2) / loose[1] ** 2
        expected += 1e-6 * np.sum(heights**2) / 0.3**2
        np.testing.assert_allclose(heights.ravel() @ smoothness(knots, size) @ heights.ravel(), expected)
