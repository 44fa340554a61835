"""Points moved onto several surfaces at once: the shortest way, by a formula where there are two of them."""

import numpy as np
from face_maps import bowed, floor, wall

from bsmap_cli.core.bspline import design_matrix
from bsmap_cli.fit.heights import Knots, basis_matrix, flat_knots
from bsmap_cli.merge.bases import field_of
from bsmap_cli.merge.curves import PARALLEL, _steps, onto
from bsmap_cli.merge.shapes import above


def test_shortest_way_onto_two_surfaces_is_that_of_the_pseudoinverse():
    rng = np.random.default_rng(0)
    normals, heights = rng.normal(size=(600, 2, 3)), rng.normal(size=(600, 2))
    for some, sign in ((slice(0, 200), 1.0), (slice(200, 400), -1.0)):
        normals[some, 1] = sign * normals[some, 0] + 0.05 * rng.normal(size=(200, 3))
    normals[0, 1], normals[1, 1] = normals[0, 0], -normals[1, 0]
    normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    wanted = (np.linalg.pinv(normals, rcond=PARALLEL) @ heights[..., None])[..., 0]
    np.testing.assert_allclose(_steps(normals, heights), wanted, atol=1e-12)


def test_points_come_to_lie_on_both_surfaces():
    shapes = [field_of(bowed(wall("a/1", 0.0, 4.0), 0.1)), field_of(floor("a/2", 0.0, 4.0))]
    points = np.array([[0.75, 0.055, 0.02], [3.2, 0.065, -0.01]])
    placed = onto(shapes, points)
    assert np.linalg.norm(placed - points, axis=1).max() < 0.05
    assert max(np.abs(above(shape, placed)[0]).max() for shape in shapes) < 1e-6


def test_basis_of_the_least_surface_is_the_product_of_both_directions():
    uv = np.random.default_rng(1).uniform(-0.2, 1.2, (50, 2))
    flat: Knots = flat_knots()
    u, v = (design_matrix(flat.s, 1, np.clip(uv[:, k], 0.0, 1.0)) for k in (0, 1))
    np.testing.assert_allclose(basis_matrix(flat, uv), (u[:, :, None] * v[:, None]).reshape(50, 4), atol=1e-15)
