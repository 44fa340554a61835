"""Cutting patches keeps their shape and carries their covariance; rectangles of overlaps; visible sides."""

import numpy as np
import pytest
from merge_scenes import plane, wall

from bsmap_cli.core.bspline import evaluate_surface, restrict
from bsmap_cli.core.gaussian import pack, symmetric_sqrt, unpack
from bsmap_cli.merge.covariance import carry, correlation, share_pose
from bsmap_cli.merge.facing import visible_normals
from bsmap_cli.merge.overlap import best_rectangle, outline, rectangle
from bsmap_cli.merge.patch import Window, cut, make_patch, surroundings
from bsmap_cli.model import BSplineSurface, PosePart, SurfaceCovariance

WINDOW = Window(0.17, 0.8, 0.25, 0.66)


def bumpy(seed: int = 0) -> BSplineSurface:
    """Wall with random bumps and random covariance blocks."""
    rng = np.random.default_rng(seed)
    surface = wall("bumpy", 0.0, 4.0)
    n, m = surface.control_points.shape[:2]
    half = rng.normal(size=(n, m, 3, 3)) * 0.003
    blocks = pack(half @ np.swapaxes(half, -1, -2) + 1e-8 * np.eye(3))
    points = surface.control_points + 0.1 * rng.normal(size=surface.control_points.shape)
    covariance = SurfaceCovariance(
        blocks, surface.covariance.correlation_u, surface.covariance.correlation_v, surface.covariance.pose
    )
    return BSplineSurface(
        "bumpy", ("bumpy",), 3, 3, surface.knots_u, surface.knots_v, points, covariance, surface.residuals
    )


def dense(covariance: SurfaceCovariance) -> np.ndarray:
    """The sensor part of all control points, (nu nv 3, nu nv 3), as the structure defines it."""
    L = symmetric_sqrt(unpack(covariance.blocks))
    C = np.einsum("ijxz,ik,jl,klyz->ijxkly", L, covariance.correlation_u, covariance.correlation_v, L)
    size = L.shape[0] * L.shape[1] * 3
    return C.reshape(size, size)


def test_cut_keeps_the_shape() -> None:
    patch = make_patch(bumpy())
    piece = cut(patch, WINDOW, "piece")
    rng = np.random.default_rng(1)
    s, t = rng.random((2, 200))
    u, v = WINDOW.u0 + s * (WINDOW.u1 - WINDOW.u0), WINDOW.v0 + t * (WINDOW.v1 - WINDOW.v0)
    np.testing.assert_allclose(
        evaluate_surface(piece.surface, s, t), evaluate_surface(patch.surface, u, v), rtol=0, atol=1e-12
    )


def test_pieces_cover_the_patch_once() -> None:
    patch = make_patch(bumpy())
    pieces = [WINDOW, *surroundings(patch, WINDOW)]
    assert len(pieces) == 5
    assert sum((w.u1 - w.u0) * (w.v1 - w.v0) for w in pieces) == pytest.approx(1.0, abs=1e-12)
    assert surroundings(patch, Window(0.0, 1.0, 0.0, 0.5)) == [Window(0.0, 1.0, 0.5, 1.0)]


def test_blocks_of_a_piece_equal_the_dense_computation() -> None:
    surface = bumpy()
    U = restrict(surface.knots_u, 3, WINDOW.u0, WINDOW.u1).matrix
    V = restrict(surface.knots_v, 3, WINDOW.v0, WINDOW.v1).matrix
    A = np.kron(np.kron(U, V), np.eye(3))
    wanted = A @ dense(surface.covariance) @ A.T
    got = unpack(carry(surface.covariance, U, V).blocks).reshape(-1, 3, 3)
    for k, block in enumerate(got):
        np.testing.assert_allclose(block, wanted[3 * k : 3 * k + 3, 3 * k : 3 * k + 3], rtol=1e-9, atol=1e-16)


def test_correlations_are_exact_for_equal_blocks() -> None:
    surface = wall("a", 0.0, 4.0)
    U = restrict(surface.knots_u, 3, WINDOW.u0, WINDOW.u1).matrix
    V = restrict(surface.knots_v, 3, WINDOW.v0, WINDOW.v1).matrix
    A = np.kron(np.kron(U, V), np.eye(3))
    carried = carry(surface.covariance, U, V)
    np.testing.assert_allclose(dense(carried), A @ dense(surface.covariance) @ A.T, rtol=0, atol=1e-16)


def test_correlation_of_a_component_without_variance() -> None:
    np.testing.assert_array_equal(correlation(np.array([[4.0, 0.0], [0.0, 0.0]])), np.eye(2))


def test_shares_of_the_same_data_set_add() -> None:
    a, b = (PosePart(name, np.zeros(2), np.eye(3), weight) for name, weight in (("a", 0.6), ("b", 0.4)))
    alone = PosePart("b", np.zeros(2), np.eye(3))
    shared = share_pose((a, b), (alone,), 0.5)
    assert {part.data_set: part.weight for part in shared} == pytest.approx({"a": 0.3, "b": 0.7})


def test_best_rectangle_equals_brute_force() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        values = rng.normal(size=(6, 5))
        sums = {
            (a, b, c, d): values[a:b, c:d].sum()
            for a in range(6)
            for b in range(a + 1, 7)
            for c in range(5)
            for d in range(c + 1, 6)
        }
        i0, i1, j0, j1 = best_rectangle(values)
        assert values[i0:i1, j0:j1].sum() == pytest.approx(max(sums.values()))


def test_rectangle_ends_where_the_other_surface_ends() -> None:
    first, second = make_patch(wall("a", 0.0, 4.0)), make_patch(wall("b", 2.5, 6.0))
    window = outline(first, second, 0.1).first
    assert window is not None
    assert window.v0 == pytest.approx(2.5 / 4.0, abs=1e-9)
    found = rectangle(first, window, second, 0.1, 20.0)
    assert found is not None
    assert found.area == pytest.approx(1.5 * 2.0, rel=1e-6)
    assert found.share == pytest.approx(1.0)


@pytest.mark.parametrize("turned", [False, True])
def test_normals_point_to_the_sensor_whatever_the_parameters(turned: bool) -> None:
    u, v = ((0, 0, 2.0), (4.0, 0, 0)) if not turned else ((4.0, 0, 0), (0, 0, 2.0))
    patch = make_patch(plane("a", (0.0, 2.0, 0.2), u, v, centre=(2.0, 0.0)))
    at = np.linspace(0.05, 0.95, 7)
    normals = visible_normals(patch.samples.pieces, patch.facing, at, at)
    np.testing.assert_allclose(normals, np.tile([0.0, -1.0, 0.0], (7, 1)), atol=1e-12)
