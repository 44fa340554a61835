import numpy as np

from bsmap_cli.simulate.geometry import arc, carve, join, room, solid, upright
from bsmap_cli.simulate.raycast import Caster


def corners(mesh):
    return mesh.vertices[mesh.triangles]


def normals(mesh):
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    return np.cross(b - a, c - a)


def enclosed_volume(mesh):
    """Volume by the divergence theorem; normals that point inwards make it negative."""
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    return np.sum(np.cross(a, b) * c) / 6


def rays(n, centre, seed=0):
    directions = np.random.default_rng(seed).standard_normal((n, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    return np.broadcast_to(centre, (n, 3)), directions


def slow_distances(mesh, origins, directions):
    """Moeller and Trumbore (1997) in float64, one ray after the other."""
    a, b, c = np.moveaxis(corners(mesh), 1, 0)
    out = []
    for o, d in zip(origins, directions, strict=True):
        p = np.cross(d, c - a)
        det = np.sum((b - a) * p, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = np.sum((o - a) * p, axis=1) / det
            q = np.cross(o - a, b - a)
            v, t = q @ d / det, np.sum((c - a) * q, axis=1) / det
        ok = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1 + 1e-12) & (t > 0)
        out.append(t[ok].min(initial=np.inf))
    return np.array(out)


def test_carved_room_is_closed_and_faces_inwards():
    mesh = carve([room(0, 4, 0, 3, 0, 2), room(1, 2, 1, 2, 2, 2.5), solid(3, 4, 0, 1, 0, 1)])
    assert np.isclose(enclosed_volume(mesh), -(24 + 0.5 - 1))
    edges = np.concatenate([mesh.triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    reverse = {(b, a) for a, b in edges.tolist()}
    assert reverse == set(map(tuple, edges.tolist()))
    assert len(reverse) == len(edges)


def test_later_cuts_win():
    filled = carve([room(0, 2, 0, 2, 0, 2), solid(1, 2, 0, 2, 0, 2)])
    assert np.isclose(enclosed_volume(filled), -4)
    assert np.isclose(enclosed_volume(carve([solid(1, 2, 0, 2, 0, 2), room(0, 2, 0, 2, 0, 2)])), -8)


def test_upright_wall_faces_to_the_right_of_its_line():
    wall = upright(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]), 0.0, 3.0)
    assert np.all(normals(wall) @ [0.0, -1.0, 0.0] > 0)


def test_clockwise_arc_faces_its_centre_within_a_tenth_of_a_millimetre():
    wall = upright(arc((1.0, 2.0), 3.0, 0.0, -np.pi / 2), 0.0, 3.0)
    middle = corners(wall).mean(axis=1)
    assert np.all(np.sum(normals(wall) * ([1.0, 2.0, 1.5] - middle), axis=1) > 0)
    directions = np.random.default_rng(1).uniform([0.1, -1], [1, -0.1], (200, 2))
    directions = np.column_stack([directions / np.linalg.norm(directions, axis=1)[:, None], np.zeros(200)])
    distances = Caster(wall).distances(np.broadcast_to([1.0, 2.0, 1.0], (200, 3)), directions)
    np.testing.assert_allclose(distances, 3.0, atol=1e-4)


def test_cast_distances_agree_with_a_slow_twin():
    mesh = join([carve([room(100, 130, 50, 60, 0, 3), solid(110, 111, 52, 53, 0, 1)]),
                 upright(arc((120.0, 55.0), 1.0, 0.0, 2 * np.pi, 0.1), 0, 3)])  # fmt: skip
    origins, directions = rays(300, np.array([107.0, 54.0, 1.2]))
    np.testing.assert_allclose(Caster(mesh).distances(origins, directions), slow_distances(mesh, origins, directions),
                               atol=1e-9)  # fmt: skip


def test_ray_into_the_open_is_infinite():
    wall = upright(np.array([[1.0, -1.0], [1.0, 1.0]]), 0.0, 2.0)
    directions = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    distances = Caster(wall).distances(np.tile([0.0, 0.0, 1.0], (2, 1)), directions)
    np.testing.assert_allclose(distances, [1.0, np.inf])
