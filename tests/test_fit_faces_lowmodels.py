"""Planes and circles through blocks, against least squares on the rows themselves."""

import numpy as np
import pytest

from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.lowmodels import (
    GRAZING,
    _least_squares,
    axes_of,
    ball_rows,
    fit_cylinder_frame,
    fit_plane_frame,
    plane_rows,
)


def blocks_at(points, directions, counts):
    of = np.zeros(len(points), dtype=int)
    return Blocks(points, directions / np.linalg.norm(directions, axis=1, keepdims=True), counts, of, of * 1.0, of)


@pytest.mark.parametrize("seed", range(5))
def test_plane_is_that_of_least_squares_along_the_beams(seed):
    rng = np.random.default_rng(seed)
    axes, n = np.linalg.qr(rng.normal(size=(3, 3)))[0], 200
    flat = np.column_stack([rng.uniform(-4.0, 4.0, (n, 2)), 0.01 * rng.normal(size=n)])
    blocks = blocks_at(flat @ axes.T + 5.0, rng.normal(size=(n, 3)) @ axes.T, rng.integers(1, 9, n) * 1.0)
    frame = fit_plane_frame(blocks)
    N, height, root = plane_rows(frame, blocks, 3)
    root = root * np.sqrt(blocks.counts)
    np.testing.assert_allclose(np.linalg.lstsq(N * root[:, None], height * root, rcond=None)[0], 0.0, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_circle_is_that_of_least_squares_along_the_beams(seed):
    rng = np.random.default_rng(seed)
    n = 200
    angle = rng.uniform(0.0, 2.0, n) + rng.uniform(0.0, 6.0)
    way = np.column_stack([np.cos(angle), np.sin(angle), rng.normal(size=n)])
    points = [3.0, -20.0, 0.0] + rng.uniform(0.3, 3.0) * way + 0.003 * rng.normal(size=(n, 3))
    blocks = blocks_at(points, way + 0.5 * rng.normal(size=(n, 3)), rng.integers(1, 9, n) * 1.0)
    found = fit_cylinder_frame(blocks)
    N, data, root = ball_rows(found, blocks)
    root = root * np.sqrt(blocks.counts)
    a, b, c = np.linalg.lstsq(N * root[:, None], data * root, rcond=None)[0]
    # Its weights are those of the circle before it.
    assert np.hypot(a, b) < 1e-5 * found.radius
    assert np.sqrt(c + a * a + b * b) == pytest.approx(found.radius, rel=1e-5)


def test_no_circle_is_found_in_a_straight_wall():
    along = np.linspace(0.0, 4.0, 50)
    points = np.column_stack([along, 0.5 * along + 0.003 * np.random.default_rng(0).normal(size=50), np.zeros(50)])
    assert fit_cylinder_frame(blocks_at(points, np.tile([0.5, -1.0, GRAZING], (50, 1)), np.ones(50))) is None


def test_axes_are_orthonormal_and_level_where_the_normal_is_not_steep():
    rng = np.random.default_rng(0)
    for normal in (*rng.normal(size=(50, 3)), np.array([0.0, 0.0, 2.0]), np.array([3.0, 0.0, 0.0])):
        axes = axes_of(normal)
        np.testing.assert_allclose(axes.T @ axes, np.eye(3), atol=1e-14)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        np.testing.assert_allclose(axes[:, 2], normal / np.linalg.norm(normal), atol=1e-15)
        assert axes[2, 0] == 0.0 or abs(axes[2, 2]) > 0.8


def test_three_unknowns_are_those_of_many_systems_at_once():
    rng = np.random.default_rng(0)
    for scale in (1.0, 1e-4, 1e6):
        rows = rng.standard_normal((50, 4)) * [1.0, scale, 1.0, 1.0]
        G = rows.T @ rows
        wanted = np.linalg.lstsq(rows[:, :3], rows[:, 3], rcond=None)[0]
        np.testing.assert_allclose(_least_squares(G), wanted, rtol=1e-8)
        np.testing.assert_allclose(_least_squares(np.stack([G, G]))[1], wanted, rtol=1e-8)
        assert _least_squares(G[None]).shape == (1, 3)
    # Of what the rows do not tell, nearly the least.
    rows[:, 1] = rows[:, 0]
    np.testing.assert_allclose(_least_squares(rows.T @ rows)[0], _least_squares(rows.T @ rows)[1], rtol=1e-2)
    assert np.all(np.isfinite(_least_squares(np.zeros((4, 4)))))
