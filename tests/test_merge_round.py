"""Round walls and pillars of several data sets become one face, as flat ones do."""

from dataclasses import replace

import numpy as np
import pytest
from face_maps import SIGMA, bowed, map_of, wall
from round_maps import arc, floor_around
from test_merge_topology import check_creases

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.uncertainty import sensor_covariance
from bsmap_cli.export.tessellation import tessellate_map
from bsmap_cli.fit.heights import evaluate
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.bases import based_face, field_of
from bsmap_cli.merge.shapes import parameters_along, parameters_of, spline_shape
from bsmap_cli.model import Crease, TrimLoop
from bsmap_cli.params import MergeParams

INSIDE = (0.0, 0.0)


def merged(*surfaces, creases=()):
    return merge_surfaces([map_of(*surfaces, creases=creases)], MergeParams())


def off(surface, radius):
    """Distances of a grid on a surface to the cylinder about z."""
    uv = np.stack(np.meshgrid(np.linspace(0, 1, 41), np.linspace(0, 1, 9)), axis=-1).reshape(-1, 2)
    return np.hypot(*evaluate_surface(surface, *uv.T)[:, :2].T) - radius


def area(mesh):
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


@pytest.mark.parametrize("sigma", [5e-4, 1e-3, 4e-3])
def test_arcs_of_a_round_wall_become_one_face_that_is_nearer_to_the_truth(sigma):
    before, after, held = [], [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        ends = [(0.0, 0.9), (0.2, 1.3), (0.6, 1.6), (0.1, 1.5)]
        parts = [arc(f"{n}/1", 3.0, *e, sensor=INSIDE, sigma=sigma, rng=rng) for n, e in zip("abcd", ends, strict=True)]
        result = merged(*parts)
        (one,) = result.surfaces
        assert one.data_sets == ("a", "b", "c", "d")
        assert based_face(one).area == pytest.approx(1.6 * 3.0 * 2.5, rel=0.005)
        before += [np.mean(off(part, 3.0) ** 2) for part in parts]
        after.append(np.mean(off(one, 3.0) ** 2))
        covariance = sensor_covariance(one, np.array([0.5]), np.array([0.5]))[0]
        at = evaluate_surface(one, np.array([0.5]), np.array([0.5]))[0]
        outwards = np.append(at[:2] / np.hypot(*at[:2]), 0.0)
        held.append((np.hypot(*at[:2]) - 3.0) ** 2 / (outwards @ covariance @ outwards))
    assert np.mean(after) < 0.6 * np.mean(before)
    assert 0.2 < np.mean(held) < 2.5


def test_order_of_round_faces_does_not_matter():
    rng = np.random.default_rng(0)
    parts = [arc(f"{n}/1", 0.25, s, s + 2.0, sensor=(0.0, 2.0), rng=rng) for n, s in zip("abc", (0, 1, 2), strict=True)]
    one, other = merged(*parts).surfaces[0], merged(*parts[::-1]).surfaces[0]
    np.testing.assert_allclose(one.control_points, other.control_points, rtol=0, atol=1e-9)


@pytest.mark.parametrize("thickness", [0.05, 0.2])
def test_both_sides_of_a_round_wall_stay_apart(thickness):
    sides = arc("a/1", 3.0, 0.0, 1.5, sensor=INSIDE), arc("b/1", 3.0 + thickness, 0.0, 1.5, sensor=(5.0, 5.0))
    assert len(merged(*sides).surfaces) == 2


def stand(faces: list, creases: list, name: str, number: int, start: float, turn: float) -> None:
    """Add a data set's pillar, seen over `turn` from angle `start` on, the floor around it and the crease of both."""
    pillar = arc(f"{name}/1", 0.25, start, start + turn, sensor=(0.0, -2.0), marks=(number, -1, -1, -1))
    ground, crease = floor_around(f"{name}/2", pillar, number)
    faces += [pillar, ground]
    creases.append(crease)


@pytest.mark.parametrize("starts", [(0.0, 0.9), (2.6, 3.4), (5.0, 6.0)])
def test_pillar_seen_from_two_sides_stands_on_the_floor_in_one_crease(starts):
    """Wherever about its axis the faces begin; the floor of both data sets is one."""
    faces, creases = [], []
    for number, (name, start) in enumerate(zip("ab", starts, strict=True)):
        stand(faces, creases, name, number, start, 3.0)
    result = merged(*faces, creases=creases)
    assert len(result.surfaces) == 2
    (crease,) = result.creases
    length = np.linalg.norm(np.diff(crease.points, axis=0), axis=1).sum()
    assert length == pytest.approx(0.25 * (3.0 + starts[1] - starts[0]), abs=0.02)
    check_creases(result, 1e-4)
    pillar = next(s for s in result.surfaces if len(s.covariance.directions) > 1)
    assert based_face(pillar).area == pytest.approx(2.5 * length, abs=0.03)


def test_pillar_seen_all_around_is_one_face_in_a_hole_of_the_floor():
    faces, creases = [], []
    for number, name in enumerate("abc"):
        stand(faces, creases, name, number, 2.0 * np.pi / 3.0 * number, 2.6)
    result = merged(*faces, creases=creases)
    assert len(result.surfaces) == 2
    assert len(result.creases) == 1
    check_creases(result, 1e-4)
    areas = sorted(area(mesh) for mesh in tessellate_map(result, 0.002))
    # The crease ends at the last sides that were seen.
    assert areas == pytest.approx([4.0 - np.pi * 0.25**2, 2.0 * np.pi * 0.25 * 2.5], abs=0.06)


def test_field_over_a_cylinder_is_that_of_its_surface():
    surface = arc("a/1", 0.8, 0.3, 2.4, sensor=INSIDE, sigma=3e-3, rng=np.random.default_rng(4))
    field = field_of(surface)
    uv = np.random.default_rng(0).uniform(size=(200, 2))
    local = field.base.local(evaluate_surface(surface, *uv.T))
    assert np.abs(local[:, 2] - evaluate(field, field.parameters(local))[0]).max() < 2e-4


@pytest.mark.parametrize("end", [0.0, 1.0])
def test_corners_where_a_round_face_begins_again_lie_at_the_end_on_which_their_outline_is(end):
    shape = spline_shape(arc("a/1", 1.0, 0.001 - np.pi, np.pi - 0.001, sensor=INSIDE))
    away = np.array([0.0, 0.02, 0.4, 0.4, 0.02, 0.0])
    uv = np.column_stack([np.abs(end - away), [0.2, 0.2, 0.2, 0.8, 0.8, 0.8]])
    other = uv.copy()
    other[[0, -1], 0] = 1.0 - end
    for placed in (uv, other):
        points = evaluate_surface(shape.surface, *placed.T)
        np.testing.assert_allclose(parameters_of(shape, points), placed, atol=1e-6)
        np.testing.assert_allclose(parameters_along(shape, points), uv, atol=1e-3)
    open_one = spline_shape(arc("a/1", 1.0, -2.0, 2.0, sensor=INSIDE))
    points = evaluate_surface(open_one.surface, *other.T)
    np.testing.assert_array_equal(parameters_along(open_one, points), parameters_of(open_one, points))


@pytest.mark.parametrize("bow", [0.0, 0.03, 0.08])
def test_half_pillar_and_the_bent_wall_beside_it_share_their_crease(bow):
    """Both are curved, and three data sets saw both."""
    rng, faces, creases = np.random.default_rng(1), [], []
    for number, name in enumerate("abc"):
        pillar = arc(f"{name}/1", 0.3, 0.0, np.pi, sensor=(0.5, 2.0), rng=rng, marks=(-1, -1, -1, number))
        flat = wall(f"{name}/2", 0.3, 4.3, noise=rng.normal(0.0, SIGMA, (2, 2)))
        side = bowed(flat, bow) if bow else flat
        side = replace(side, trims=(TrimLoop(side.trims[0].parameters, np.array([-1, -1, -1, number])),))
        faces += [pillar, side]
        creases.append(Crease((pillar.name, side.name), np.array([[0.3, 0.0, 0.0], [0.3, 0.0, 2.5]])))
    result = merge_surfaces([map_of(*faces, creases=creases)], MergeParams())
    assert len(result.surfaces) == 2
    (crease,) = result.creases
    np.testing.assert_allclose(crease.points[[0, -1]], [[0.3, 0.0, 0.0], [0.3, 0.0, 2.5]], atol=0.002)
    meshes = tessellate_map(result, 0.002)
    shared = [{tuple(v) for v in mesh.vertices if np.abs(v[:2] - [0.3, 0.0]).max() < 0.003} for mesh in meshes]
    assert shared[0] == shared[1]
    assert len(shared[0]) >= 2
