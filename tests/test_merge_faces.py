"""Faces of several data sets joined to one map: what is one becomes one, what is two stays two."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import shapely
from face_maps import SIGMA, bow, bowed, floor, map_of, wall, with_crease
from face_scenes import simulated_place
from scenes import simulated

from bsmap_cli.cloud import make_cloud
from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.trims import inside_trims
from bsmap_cli.core.uncertainty import is_plane, sensor_covariance, surface_covariance
from bsmap_cli.evaluate import distance_to_mesh, surface_samples
from bsmap_cli.export.tessellation import tessellate
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.bases import based_face
from bsmap_cli.merge.regions import region_of, united, without_mitres
from bsmap_cli.model import SurfaceMap
from bsmap_cli.params import CloudParams, FitParams, MergeParams, SlamParams
from bsmap_cli.slam import run_slam


def merged(*surfaces, **params):
    return merge_surfaces([map_of(*surfaces)], MergeParams(**params))


def area(surface):
    return based_face(surface).area


def covers(surface, x, z):
    """Whether a wall along x is there at (x, z)."""
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 201), np.linspace(0, 1, 201), indexing="ij"), -1).reshape(-1, 2)
    at = evaluate_surface(surface, *grid.T)
    nearest = np.argmin((at[:, 0] - x) ** 2 + (at[:, 2] - z) ** 2)
    return bool(inside_trims(surface, grid[nearest : nearest + 1])[0])


def test_overlapping_halves_of_a_wall_become_one_plane_with_less_variance():
    rng = np.random.default_rng(1)
    noises = [rng.normal(0.0, SIGMA, (2, 2)) for _ in range(2)]
    parts = wall("a/1", 0.0, 4.0, noise=noises[0]), wall("b/1", 1.0, 6.0, noise=noises[1])
    result = merged(*parts)
    (one,) = result.surfaces
    assert one.data_sets == ("a", "b")
    assert area(one) == pytest.approx(15.0, abs=0.01)
    assert np.abs(one.control_points[..., 1]).max() < 4 * SIGMA
    at = np.array([[2.0, 1.2]])
    before = min(
        sensor_covariance(p, *((at - [p.control_points[0, 0, 0], 0.0]) / [w, 2.5]).T)[0, 1, 1]
        for p, w in zip(parts, (4.0, 5.0), strict=True)
    )
    uv = np.array([[0.5, 0.5]])
    assert sensor_covariance(one, *uv.T)[0, 1, 1] < before
    assert [d.outcome for d in result.decisions] == ["merged"]


@pytest.mark.parametrize("twist", [0.0, 0.001])
def test_fused_heights_are_those_of_generalised_least_squares(twist):
    """Of the same rectangle twice: c = (A + B)^-1 (A a + B b), and its covariance by the gains.

    Where the fourth height does not pay, of all planes the one nearest to that.
    """
    rng = np.random.default_rng(3)
    shape = np.array([[1.0, -1.0], [-1.0, 1.0]])
    noises = [twist * shape + rng.normal(0.0, SIGMA, (2, 2)) for _ in range(2)]
    parts = [wall(f"{name}/1", 0.0, 4.0, noise=n) for name, n in zip("ab", noises, strict=True)]
    (one,) = merged(*parts).surfaces
    # Same covariance both: the mean, and half of it.
    corners = one.control_points.reshape(-1, 3)
    wanted = np.mean([p.control_points for p in parts], axis=0)
    left = 4.0 if twist else 3.0
    if not twist:
        wanted[..., 1] -= shape * np.sum(shape * wanted[..., 1]) / 4.0
    wanted = wanted.reshape(-1, 3)
    order = [int(np.argmin(np.linalg.norm(corners - w, axis=1))) for w in wanted]
    np.testing.assert_allclose(corners[order], wanted, atol=2e-6)
    np.testing.assert_allclose(np.diag(one.covariance.matrix), SIGMA**2 / 2 * left / 4.0, rtol=1e-3)
    assert is_plane(one.covariance.matrix) == (left == 3.0)


def test_pose_parts_are_carried_with_shares_that_add_up_to_one():
    pose = np.diag([1e-6, 1e-6, 1e-8])
    (one,) = merged(wall("a/1", 0.0, 4.0, pose=pose), wall("b/1", 1.0, 6.0, pose=pose)).surfaces
    assert sum(part.weight for part in one.covariance.pose) == pytest.approx(1.0)
    assert {part.data_set for part in one.covariance.pose} == {"a", "b"}
    uv = np.array([0.5]), np.array([0.5])
    total, sensor = surface_covariance(one, *uv)[0], sensor_covariance(one, *uv)[0]
    assert 0.4e-6 < total[1, 1] - sensor[1, 1] < 1.1e-6


@pytest.mark.parametrize("thickness", [0.05, 0.1, 0.2])
def test_two_sides_of_a_thin_wall_stay_two(thickness):
    pose = np.diag([0.02**2, 0.02**2, 1e-6])
    sides = [wall("a/1", 0.0, 4.0, pose=pose), wall("b/1", 0.0, 4.0, offset=-thickness, sensor=-1.5, pose=pose)]
    result = merged(*sides)
    assert len(result.surfaces) == 2
    assert all("opposite" in d.reason or "farther apart" in d.reason for d in result.decisions)


@pytest.mark.parametrize(("sides", "count"), [((1, 1), 1), ((1, -1), 2), ((-1, -1), 1)])
def test_side_of_the_beams_counts_and_not_where_the_middle_of_the_data_set_lies(sides, count):
    # Passing a corner, a robot sees the wall round it at the end of its way, whose middle lies behind that wall.
    walls = wall("a/01", 0.0, 3.0, sensor=1.5), wall("b/01", 2.0, 4.0, sensor=-1.5)
    found = merged(*(replace(one, side=side) for one, side in zip(walls, sides, strict=True)))
    assert len(found.surfaces) == count
    for surface in found.surfaces:
        P = surface.control_points
        seen = surface.side * np.cross(P[-1, 0] - P[0, 0], P[0, -1] - P[0, 0])[1]
        before = [side for side, one in zip(sides, walls, strict=True) if set(one.data_sets) & set(surface.data_sets)]
        assert np.sign(seen) == -before[0]  # S_u x S_v of these walls points along -y


def test_step_of_four_centimetres_stays_apart_under_uncertain_poses():
    """Both parts are seen by both data sets, with poses so uncertain that the gate alone would let them pass."""
    pose = np.diag([0.02**2, 0.02**2, 1e-8])
    parts = [
        wall(f"{name}/{k}", start, start + 3.0, offset=offset, pose=pose)
        for name in "ab"
        for k, (start, offset) in enumerate([(0.0, 0.0), (2.95, 0.04)])
    ]
    result = merged(*parts)
    assert len(result.surfaces) == 2
    levels = sorted(np.mean(s.control_points[..., 1]) for s in result.surfaces)
    np.testing.assert_allclose(levels, [0.0, 0.04], atol=1e-3)
    assert any("apart" in d.reason for d in result.decisions if d.outcome == "refused")


def test_pose_error_of_one_data_set_does_not_double_the_walls():
    """Three walls at right angles, seen by two data sets, of which one is 2 cm off in both directions."""
    pose = np.diag([0.02**2, 0.02**2, 1e-6])
    first = [wall("a/1", 0.0, 4.0, pose=pose), wall("a/2", 0.0, 4.0, offset=3.0, pose=pose)]
    second = [wall("b/1", 0.0, 4.0, offset=0.02, pose=pose), wall("b/2", 0.0, 4.0, offset=3.02, pose=pose)]
    result = merged(*first, *second)
    assert len(result.surfaces) == 2
    levels = sorted(np.mean(s.control_points[..., 1]) for s in result.surfaces)
    np.testing.assert_allclose(levels, [0.01, 3.01], atol=1e-3)


def in_common(surface, modes):
    """The wall with an error of pose that its trajectory has in common, and 1 mm and 0.1 mrad of its own."""
    (part,) = surface.covariance.pose
    covariance = modes @ modes.T + np.diag([1e-6, 1e-6, 1e-8])
    part = replace(part, covariance=covariance, modes=modes, trajectory="t")
    return replace(surface, covariance=replace(surface.covariance, pose=(part,)))


def test_what_poses_have_in_common_is_neither_corrected_nor_averaged_away():
    """Two walls 2 mm apart, whose poses err by 5 cm together."""
    modes = np.array([[0.05, 0.0], [0.0, 0.05], [0.0, 0.0]])
    parts = [in_common(wall(f"{n}/1", 0.0, 4.0, offset=o), modes) for n, o in (("a", 0.0), ("b", 0.002))]
    result = merged(*parts)
    (one,) = result.surfaces
    assert result.notes["largest_correction"] < 0.0015
    covariance = surface_covariance(one, np.array([0.5]), np.array([0.5]))[0]
    assert covariance[1, 1] == pytest.approx(0.05**2, rel=0.01)


def test_walls_apart_are_not_joined_for_an_error_that_both_have_in_common():
    """With independent errors of 5 cm the gate would let the same pair pass."""
    modes = np.array([[0.05, 0.0], [0.0, 0.05], [0.0, 0.0]])
    pose = np.diag([0.05**2, 0.05**2, 1e-8])
    offsets = (("a", 0.0), ("b", 0.025))
    assert len(merged(*[in_common(wall(f"{n}/1", 0.0, 4.0, offset=o), modes) for n, o in offsets]).surfaces) == 2
    assert len(merged(*[wall(f"{n}/1", 0.0, 4.0, offset=o, pose=pose) for n, o in offsets]).surfaces) == 1


def test_window_that_nobody_saw_stays_open_and_half_seen_ones_are_closed():
    window, picture = ((1.0, 1.0), (2.0, 2.0)), ((3.0, 1.0), (3.5, 2.0))
    (one,) = merged(wall("a/1", 0.0, 4.0, holes=[window, picture]), wall("b/1", 0.5, 4.5, holes=[window])).surfaces
    assert not covers(one, 1.5, 1.5)
    assert covers(one, 3.25, 1.5)
    assert area(one) == pytest.approx(4.5 * 2.5 - 1.0, abs=0.01)


def test_narrow_gap_between_data_sets_is_closed_and_a_wide_one_not():
    (one,) = merged(wall("a/1", 0.0, 2.0), wall("b/1", 2.06, 4.0)).surfaces
    assert area(one) == pytest.approx(10.0, abs=0.01)
    assert len(merged(wall("a/1", 0.0, 2.0), wall("b/1", 2.3, 4.0)).surfaces) == 2


def test_slit_inside_one_region_is_not_closed():
    outer, slit = np.array([[0, 0], [4, 0], [4, 2], [0, 2.0]]), np.array([[1, 0.5], [1, 1.5], [1.05, 1.5], [1.05, 0.5]])
    region = region_of([outer, slit])
    other = region_of([np.array([[4, 0], [6, 0], [6, 2], [4, 2.0]])])
    assert united([region, other], 0.1).area == pytest.approx(12.0 - 0.05, abs=1e-3)


def test_creases_of_joined_faces_are_joined_and_both_faces_have_their_points():
    a, low_a, crease_a = with_crease(wall("a/1", 0.0, 4.0), floor("a/2", 0.0, 4.0), 0, 0.0, 4.0)
    b, low_b, crease_b = with_crease(wall("b/1", 3.0, 6.0), floor("b/2", 3.0, 6.0), 1, 3.0, 6.0)
    result = merge_surfaces([map_of(a, low_a, b, low_b, creases=[crease_a, crease_b])], MergeParams())
    assert len(result.surfaces) == 2
    (crease,) = result.creases
    assert set(crease.surfaces) == {surface.name for surface in result.surfaces}
    assert np.ptp(crease.points[:, 0]) == pytest.approx(6.0, abs=1e-4)
    for surface in result.surfaces:
        loop = surface.trims[0]
        ends = loop.parameters[(loop.creases == 0) | (np.roll(loop.creases, 1) == 0)]
        at = evaluate_surface(surface, *ends.T)
        gap = np.linalg.norm(crease.points[:, None] - at, axis=2).min(axis=1)
        assert gap.max() < 1e-5


def test_twice_the_same_map_gives_one_map_of_it_all():
    parts = [wall("a/1", 0.0, 4.0), floor("a/2", 0.0, 4.0)]
    result = merge_surfaces([map_of(*parts), map_of(*parts)], MergeParams())
    assert len(result.surfaces) == 2
    assert {name for s in result.surfaces for name in s.data_sets} == {"a", "2.a"}


@cache
def room():
    place = simulated_place("room")
    return place, fit_surfaces(place.cloud, FitParams(method="faces"))


def test_outline_follows_a_curved_surface():
    """A bowed wall, seen twice: the sides of its outline are chords of its shape, so that a mesh can follow it."""
    parts = [bowed(wall(f"{name}/1", 0.0, 4.0), 0.1) for name in "ab"]
    (one,) = merged(*parts).surfaces
    assert one.degree_u > 1 or one.degree_v > 1
    mesh = tessellate(one, 0.002)
    middle = np.column_stack([np.linspace(0.3, 3.7, 50), 0.1 * bow(np.linspace(0.3, 3.7, 50)), np.full(50, 1.0)])
    assert distance_to_mesh(middle, mesh.vertices, mesh.triangles).max() < 0.004


def test_room_is_there_once_and_as_true_as_before():
    place, fitted = room()
    result = merge_surfaces([fitted], MergeParams())
    assert len(result.surfaces) < 0.4 * len(fitted.surfaces)
    before, after = (
        distance_to_mesh(surface_samples(m, 0.05), place.vertices, place.triangles) for m in (fitted, result)
    )
    assert after.mean() < min(4e-4, before.mean())
    assert np.quantile(after, 0.95) < 1.5e-3


@cache
def room_by_slam():
    """Faces of the room at poses of our own slam, so that data sets have errors of pose to correct."""
    slam_map = run_slam(simulated("room").log, SlamParams())
    return fit_surfaces(make_cloud(slam_map, CloudParams()), FitParams(method="faces"))


def part_of(whole, data_sets, rng):
    """The map of some of its data sets, everything in it shuffled."""
    surfaces = [s for s in whole.surfaces if set(s.data_sets) <= set(data_sets)]
    names = {s.name for s in surfaces}
    kept = [k for k in rng.permutation(len(whole.creases)) if names.issuperset(whole.creases[k].surfaces)]
    number = np.full(len(whole.creases) + 1, -1)
    number[kept] = np.arange(len(kept))
    surfaces = [replace(s, trims=tuple(replace(t, creases=number[t.creases]) for t in s.trims)) for s in surfaces]
    sets = [d for d in whole.data_sets if d.name in data_sets]
    return SurfaceMap(
        tuple(surfaces[k] for k in rng.permutation(len(surfaces))),
        tuple(sets[k] for k in rng.permutation(len(sets))),
        creases=tuple(whole.creases[k] for k in kept),
    )


def test_order_of_maps_and_of_all_in_them_does_not_matter():
    whole = room_by_slam()
    names = [d.name for d in whole.data_sets]
    made = []
    for seed, turn in ((0, 1), (1, -1), (2, -1)):
        rng = np.random.default_rng(seed)
        maps = [part_of(whole, names[:4], rng), part_of(whole, names[4:], rng)]
        made.append(merge_surfaces(maps[::turn], MergeParams()))
    assert made[0].notes["largest_correction"] > 1e-4
    assert_same(made[0], made[1])
    assert_same(made[0], made[2])


def test_order_does_not_matter_where_maps_share_their_names():
    whole = room_by_slam()
    names = [d.name for d in whole.data_sets]
    rng = np.random.default_rng(0)
    maps = [part_of(whole, names[:3], rng), part_of(whole, names[1:4], rng)]
    one, other = (merge_surfaces(maps[::turn], MergeParams()) for turn in (1, -1))
    assert len(one.data_sets) == 6
    assert_same(one, other)


def assert_same(one, other):
    """Maps that are the same to 1e-9, names included."""
    assert [s.name for s in one.surfaces] == [s.name for s in other.surfaces]
    assert [d.name for d in one.data_sets] == [d.name for d in other.data_sets]
    for a, b in zip(one.surfaces, other.surfaces, strict=True):
        assert a.data_sets == b.data_sets
        np.testing.assert_allclose(a.control_points, b.control_points, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a.covariance.matrix, b.covariance.matrix, rtol=1e-6, atol=1e-15)
        for p, q in zip(a.covariance.pose, b.covariance.pose, strict=True):
            assert p.data_set == q.data_set
            assert p.weight == pytest.approx(q.weight, abs=1e-9)
        for p, q in zip(a.trims, b.trims, strict=True):
            np.testing.assert_allclose(p.parameters, q.parameters, rtol=0, atol=1e-9)
            np.testing.assert_array_equal(p.creases, q.creases)
    assert one.decisions == other.decisions
    for a, b in zip(one.creases, other.creases, strict=True):
        assert a.surfaces == b.surfaces
        np.testing.assert_allclose(a.points, b.points, rtol=0, atol=1e-9)


def test_merged_faces_are_written_and_read(tmp_path):
    _, fitted = room()
    result = merge_surfaces([fitted], MergeParams())
    write_surfaces(tmp_path / "a.map.json", result)
    again = read_surfaces(tmp_path / "a.map.json")
    write_surfaces(tmp_path / "b.map.json", again)
    assert (tmp_path / "a.map.json").read_bytes() == (tmp_path / "b.map.json").read_bytes()
    assert len(again.creases) == len(result.creases) > 0


def test_gap_beside_a_ragged_outline_is_closed_without_a_spike():
    """Three data sets at the edge of a recess, as in a simulated room; mitres stood out 4.6 cm over all of them."""
    straight = [(-0.101, -0.051), (-0.101, -0.25), (-0.25, -0.25), (-0.25, -0.057)]
    ragged = [(0.007, -0.055), (0.003, -0.047), (0.007, -0.054), (0.007, -0.049), (0.008, -0.055), (0.012, -0.061)]
    ragged += [(0.007, -0.047), (0.022, -0.054), (0.02, -0.048), (0.038, -0.052), (0.036, -0.046), (0.053, -0.045)]
    ragged += [(0.094, -0.056), (0.092, -0.044), (0.25, -0.046), (0.25, -0.25), (0.009, -0.25)]
    sloping = [(-0.191, -0.074), (-0.092, -0.053), (0.009, -0.052), (0.011, -0.25), (-0.25, -0.25), (-0.25, -0.075)]
    regions = [region_of([np.array(corners)]) for corners in (straight, ragged, sloping)]
    whole = united(regions, 0.1)
    assert whole.bounds[3] < -0.043
    assert whole.area > sum(regions[k].area for k in (0, 1))


def test_joined_face_does_not_swing_between_what_planes_tell_of_it():
    """One of three data sets bends by 3 cm in its last 10 cm; the others saw a plane there."""
    flat = [wall(f"{name}/1", 0.0, 4.0) for name in "ab"]
    P, knots = flat[0].control_points, np.array([0.0, 0.0, 0.95, 1.0, 1.0])
    bent = replace(
        wall("c/1", 0.0, 4.0),
        knots_u=knots,
        control_points=np.stack([P[0], 0.05 * P[0] + 0.95 * P[1], P[1] + [0.0, 0.03, 0.0]]),
        covariance=replace(flat[0].covariance, matrix=SIGMA**2 * np.eye(6)),
    )
    result = merged(*flat, bent)
    at = np.stack(np.meshgrid(np.linspace(0.0, 1.0, 201), [0.1, 0.5, 0.9], indexing="ij"), axis=-1).reshape(-1, 2)
    for surface in result.surfaces:
        assert np.abs(evaluate_surface(surface, *at.T)[:, 1]).max() < 0.005


def test_slit_whose_sides_coincide_to_the_grid_is_cut_to_what_touches():
    """A fast clip of the regions to the gap's box raises there."""
    outline = [(-0.65343, -1.61574), (-0.6616, -1.63745), (-0.6534, -1.61575), (-0.36, -1.75), (-0.36, -2.2)]
    slit = [(-0.4, -2.3), (-0.84751, -2.13029), (-0.6616, -1.63746), (-0.84761, -2.13049)]
    whole = shapely.Polygon([*outline, *slit, (-1.15, -2.02), (-1.15, -1.6), (-1.05, -1.44)])
    part = shapely.Polygon([(-0.6616, -1.63746), (-0.84751, -2.13029), (-0.81014, -2.14446), (-0.84755, -2.13032)])
    found = without_mitres(part, whole)
    assert found.is_valid
    assert found.area == pytest.approx(part.area, abs=1e-5)


def test_strips_that_are_narrower_than_the_samples_of_faces_keep_their_plane():
    # Places inside lie in one line, around which a plane may turn.
    rng = np.random.default_rng(0)
    noise = 1e-3 * rng.normal(size=(2, 2, 2))
    strips = [wall(f"set-{k}/1", 0.0, 2.0, heights=(1.0, 1.04), noise=noise[k]) for k in range(2)]
    (surface,) = merge_surfaces([map_of(*strips)], MergeParams()).surfaces
    np.testing.assert_allclose(surface.control_points[..., 1], noise.mean(axis=0), atol=2e-3)
