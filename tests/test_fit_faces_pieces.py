"""Pieces of scan lines, and feet of beams on height fields."""

import numpy as np
from face_scenes import corridor_set

from bsmap_cli.core.bspline import clamped_knots
from bsmap_cli.fit.beams import make_grid
from bsmap_cli.fit.feet import find_feet, offsets, tabulate
from bsmap_cli.fit.heights import Bulge, CylinderBase, HeightField, Knots, PlaneBase, evaluate, flat_knots, offset
from bsmap_cli.fit.pieces import find_pieces


def test_first_scan_of_the_corridor_has_its_five_pieces():
    """Floor, bowed wall, ceiling, other wall, floor; corners to a beam or two."""
    grid = make_grid(corridor_set().cloud, np.arange(20))
    pieces = find_pieces(grid)
    first = pieces.row == 0
    assert first.sum() == 5
    height = grid.points[0, :, 2]
    corners = pieces.start[first][1:]
    true = [np.flatnonzero(np.abs(height) > 0.03)[0], *corners[1:3], np.flatnonzero(np.abs(height) > 0.03)[-1] + 1]
    assert np.abs(corners - true).max() <= 3


def test_noise_is_found_from_the_ranges():
    for sigma in (0.002, 0.01, 0.03):
        grid = make_grid(corridor_set(sigma).cloud, np.arange(20))
        assert abs(grid.sigma / sigma - 1.0) < 0.05


def fields():
    plane = PlaneBase(np.array([1.0, 2.0, 3.0]), np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0])
    cylinder = CylinderBase(np.array([0.5, -1.0]), 0.8, 0.3)
    leaning = cylinder._replace(upright=plane.axes)
    sphere = leaning._replace(bulge=Bulge(0.1, 1.2))
    heights = np.array([[0.0, 0.05], [-0.04, 0.1]])
    low, high = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    return [HeightField(base, low, high, flat_knots(), heights) for base in (plane, cylinder, leaning, sphere)]


def bent_field():
    """Cubic and quadratic, with inner knots."""
    knots = Knots(3, 2, clamped_knots(3, [0.25, 0.5]), clamped_knots(2, [0.5]))
    heights = np.random.default_rng(4).normal(scale=0.05, size=knots.shape)
    return HeightField(fields()[0].base, np.array([-0.5, -0.3]), np.array([1.2, 0.9]), knots, heights)


def test_feet_lie_on_the_field_and_on_their_beams():
    rng = np.random.default_rng(0)
    for field in fields():
        st = rng.uniform(-0.9, 0.9, (50, 2))
        height = evaluate(field, (st - field.low) / (field.high - field.low))[0]
        points = field.base.place(np.column_stack([st, height]))
        normals = offset(field, points)[1]
        directions = -normals + 0.3 * rng.normal(size=normals.shape)
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        along = rng.normal(scale=0.02, size=50)
        one = np.zeros(50, dtype=int)
        feet = find_feet(tabulate([field]), one, points + along[:, None] * directions, directions)
        np.testing.assert_allclose(feet.beyond, -along, atol=1e-7)
        np.testing.assert_allclose(feet.points, points, atol=1e-7)


def test_normals_are_the_gradient_of_the_offset():
    rng = np.random.default_rng(2)
    for field in fields():
        st = rng.uniform(-0.9, 0.9, (20, 2))
        height = evaluate(field, (st - field.low) / (field.high - field.low))[0]
        points = field.base.place(np.column_stack([st, height + rng.normal(scale=0.005, size=20)]))
        value, normal = offset(field, points)
        step = 1e-6
        raised = offset(field, points + step * normal)[0]
        np.testing.assert_allclose((raised - value) / step, 1.0, atol=0.02)


def test_many_faces_at_once_give_the_feet_and_offsets_of_each():
    rng = np.random.default_rng(3)
    every = [*fields(), bent_field()]
    face = rng.integers(len(every), size=3000)
    points = rng.normal(size=(3000, 3)) * 0.3 + np.array([1.0, 1.0, 2.0])
    directions = rng.normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    feet = find_feet(tabulate(every), face, points, directions, steps=1)
    # Short lists are taken beam by beam, long ones face by face.
    for steps in (1, 4):
        long = find_feet(tabulate(every), face, points, directions, steps=steps)
        short = find_feet(tabulate(every), face[:500], points[:500], directions[:500], steps=steps)
        good = np.abs(short.slope) > 0.2
        for one, other in zip(short, long, strict=True):
            np.testing.assert_allclose(one[good], other[:500][good], atol=1e-12 if steps == 1 else 1e-5)
    value, normal = offsets(tabulate(every), face, points)
    for number, field in enumerate(every):
        of = face == number
        alone = find_feet(tabulate([field]), np.zeros(of.sum(), dtype=int), points[of], directions[of], steps=1)
        np.testing.assert_allclose(feet.beyond[of], alone.beyond, atol=1e-12)
        np.testing.assert_allclose(feet.uv[of], alone.uv, atol=1e-12)
        one_value, one_normal = offset(field, points[of])
        np.testing.assert_allclose(value[of], one_value, atol=1e-12)
        np.testing.assert_allclose(normal[of], one_normal, atol=1e-12)
