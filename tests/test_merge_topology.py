"""Faces, creases and corners of a merged map are one: creases are shared, corners single, open borders stay open."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import trimesh
from face_maps import bow, bowed, boxed, floor, map_of, plate, wall
from face_scenes import simulated_place

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.uncertainty import sensor_covariance
from bsmap_cli.export.tessellation import tessellate_map
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.bases import field_of, places_on
from bsmap_cli.merge.extent import extended
from bsmap_cli.model import BSplineSurface, Crease, SurfaceMap, TrimLoop
from bsmap_cli.params import FitParams, MergeParams

LOW, HIGH = (0.0, 0.0, 0.0), (5.0, 4.0, 2.5)


def merged(*maps):
    return merge_surfaces(maps, MergeParams())


def whole_mesh(surface_map, tolerance=0.002):
    """One mesh of all faces, vertices that are the same to the last bit merged."""
    meshes = tessellate_map(surface_map, tolerance)
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    vertices, number = np.unique(np.concatenate([mesh.vertices for mesh in meshes]), axis=0, return_inverse=True)
    triangles = np.concatenate([mesh.triangles + o for mesh, o in zip(meshes, offsets, strict=True)])
    return trimesh.Trimesh(vertices, number[triangles], process=False)


def check_creases(surface_map, within=1e-6):
    """What holds of every map: sides along creases are the creases' points; these lie on both surfaces."""
    by_name = {surface.name: surface for surface in surface_map.surfaces}
    for number, crease in enumerate(surface_map.creases):
        for end, corner in zip((crease.points[0], crease.points[-1]), crease.corners, strict=True):
            assert corner < 0 or np.array_equal(end, surface_map.corners[corner])
        for name in crease.surfaces:
            sides, wanted = sides_along(by_name[name], number), segments(crease.points)
            assert len(sides) == len(wanted)
            off = np.abs(np.array(sides)[:, None] - wanted).max(axis=(2, 3))
            assert off.min(axis=0).max() < within
            assert off.min(axis=1).max() < within


def sides_along(surface, number):
    """Ends of the sides of a surface's loops along a crease, as of `segments`."""
    out = []
    for loop in surface.trims:
        at = evaluate_surface(surface, *loop.parameters.T)
        closed = segments(np.concatenate([at, at[:1]]))
        out += [closed[k] for k in np.flatnonzero(loop.creases == number)]
    return out


def segments(points):
    """Both ends of each segment of a polyline, the lower one (to a tenth of a millimetre) first."""
    pairs = pairwise(points)
    return [(a, b) if tuple(a.round(4) + 0.0) < tuple(b.round(4) + 0.0) else (b, a) for a, b in pairs]


def degrees(surface_map):
    """How many creases end in each corner."""
    return np.bincount([c for crease in surface_map.creases for c in crease.corners if c >= 0])


def test_box_has_six_faces_twelve_creases_eight_corners_and_a_closed_mesh():
    result = merged(boxed("a", LOW, HIGH))
    assert (len(result.surfaces), len(result.creases), len(result.corners)) == (6, 12, 8)
    assert degrees(result).tolist() == [3] * 8
    check_creases(result)
    mesh = whole_mesh(result)
    assert mesh.is_watertight
    assert len(mesh.vertices) == 8
    assert len(mesh.faces) == 12


def halves(shift=0.0):
    """A box that two data sets see half each; the second one's pose is off by `shift` metres in height."""
    west = ["floor", "ceiling", "south", "north", "west"]
    east = ["floor", "ceiling", "south", "north", "east"]
    moved = np.array([0.0, 0.0, shift])
    return boxed("a", LOW, (3.0, 4.0, 2.5), west), boxed("b", np.add((2.0, 0.0, 0.0), moved), np.add(HIGH, moved), east)


@pytest.mark.parametrize("shift", [0.0, 0.002])
def test_box_of_two_halves_is_closed_too(shift):
    result = merged(*halves(shift))
    assert (len(result.surfaces), len(result.creases), len(result.corners)) == (6, 12, 8)
    check_creases(result)
    mesh = whole_mesh(result)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(50.0, rel=0.002) or mesh.volume == pytest.approx(-50.0, rel=0.002)


def test_corners_lie_on_all_faces_that_meet_there():
    result = merged(*halves(0.002))
    by_name = {surface.name: field_of(surface) for surface in result.surfaces}
    for number, corner in enumerate(result.corners):
        names = {name for crease in result.creases if number in crease.corners for name in crease.surfaces}
        assert len(names) == 3
        for name in names:
            base = by_name[name].base
            assert abs(base.local(corner[None])[0, 2]) < 2e-3  # the fused plane is hardly tilted
    check_creases(result)


def test_missing_side_leaves_its_four_edges_open():
    result = merged(boxed("a", LOW, HIGH, ("floor", "south", "north", "west", "east")))
    assert (len(result.surfaces), len(result.creases), len(result.corners)) == (5, 8, 4)
    assert sorted(c for crease in result.creases for c in crease.corners if c < 0) == [-1] * 4
    check_creases(result)
    mesh = whole_mesh(result)
    assert not mesh.is_watertight
    edges, count = np.unique(np.sort(mesh.edges, axis=1), axis=0, return_counts=True)
    ends = mesh.vertices[edges[count == 1]]
    assert np.all(ends[..., 2] == pytest.approx(2.5, abs=1e-9))


def cut_short(surface, along_u, along_v):
    """The plate without the triangle at its first corner, with legs of these lengths in metres."""
    loop, P = surface.trims[0], surface.control_points
    first = [along_u / np.linalg.norm(P[1, 0] - P[0, 0]), 0.0]
    last = [0.0, along_v / np.linalg.norm(P[0, 1] - P[0, 0])]
    parameters = np.concatenate([[first], loop.parameters[1:], [last]])
    return BSplineSurface(**{**vars(surface), "trims": (TrimLoop(parameters, np.append(loop.creases, -1)),)})


def without_corner(lengths, sides=("floor",)):
    """Box of which some sides lack the corner at the origin."""
    whole = boxed("a", LOW, HIGH)
    faces = [cut_short(s, *lengths) if s.name.split("/")[1] in sides else s for s in whole.surfaces]
    return SurfaceMap(tuple(faces), whole.data_sets, creases=whole.creases)


def test_small_open_corner_is_closed():
    result = merged(without_corner((0.08, 0.05), ("floor", "south", "west")))
    assert (len(result.creases), len(result.corners)) == (12, 8)
    check_creases(result)
    assert whole_mesh(result).is_watertight


def test_corner_of_the_floor_is_filled_where_both_walls_reach_it():
    result = merged(without_corner((0.45, 0.3)))
    assert (len(result.creases), len(result.corners)) == (12, 8)
    assert whole_mesh(result).is_watertight


def test_larger_open_corner_stays_open():
    result = merged(without_corner((0.45, 0.3), ("floor", "south", "west")))
    check_creases(result)
    assert sum(c < 0 for crease in result.creases for c in crease.corners) == 3
    assert not whole_mesh(result).is_watertight


def narrowed(surface, metres, lost):
    """The plate without its first metres along u; without the crease `lost`."""
    loop, P = surface.trims[0], surface.control_points
    parameters = loop.parameters.copy()
    parameters[[0, 3], 0] = metres / np.linalg.norm(P[1, 0] - P[0, 0])
    return BSplineSurface(
        **{**vars(surface), "trims": (TrimLoop(parameters, np.where(loop.creases == lost, -1, loop.creases)),)}
    )


@pytest.mark.parametrize(("short", "creases"), [(0.03, 12), (0.3, 11)])
def test_edge_between_two_scans_is_found_where_both_walls_come_to_it(short, creases):
    whole = boxed("a", LOW, HIGH)
    names = {"a/south", "a/west"}
    lost = next(k for k, crease in enumerate(whole.creases) if set(crease.surfaces) == names)
    faces = tuple(narrowed(s, short, lost) if s.name in names else s for s in whole.surfaces)
    result = merged(SurfaceMap(faces, whole.data_sets, creases=whole.creases))
    assert len(result.creases) == creases
    assert any(set(crease.surfaces) == names for crease in result.creases) == (short < 0.1)
    check_creases(result)
    assert whole_mesh(result).is_watertight == (short < 0.1)


@pytest.mark.parametrize(("short", "creases"), [((0.07, 0.02), 12), ((0.02, 0.07), 12), ((0.07, 0.06), 11)])
def test_edge_that_nobody_saw_is_found_where_both_walls_together_come_within_the_gap(short, creases):
    whole = boxed("a", LOW, HIGH)
    names = {"a/south": short[0], "a/west": short[1]}
    lost = next(k for k, crease in enumerate(whole.creases) if set(crease.surfaces) == set(names))
    faces = tuple(narrowed(s, names[s.name], lost) if s.name in names else s for s in whole.surfaces)
    result = merged(SurfaceMap(faces, whole.data_sets, creases=whole.creases))
    assert len(result.creases) == creases
    assert whole_mesh(result).is_watertight


def below(surface, *corners):
    """The plate, its side along v = 0 with more corners: metres along u and v, and whether the crease runs on."""
    loop, P = surface.trims[0], surface.control_points
    size = np.linalg.norm([P[1, 0] - P[0, 0], P[0, 1] - P[0, 0]], axis=1)
    more = np.array([corner[:2] for corner in corners]) / size
    marks = [loop.creases[0] if on else -1 for *_, on in corners]
    parameters = np.insert(loop.parameters, [1] * len(more), more, axis=0)
    return replace(surface, trims=(TrimLoop(parameters, np.insert(loop.creases, [1] * len(more), marks)),))


def notched(surface, depth):
    """The plate without a triangle 10 cm wide at its side v = 0: what a scan lacks whose beams miss the crease."""
    return below(surface, (2.0, 0.0, False), (2.05, depth, False), (2.1, 0.0, True))


@pytest.mark.parametrize(("depths", "creases"), [((0.07, 0.08), 12), ((0.02, 0.08), 12), ((0.07, 0.15), 13)])
def test_notch_of_one_scan_at_a_crease_is_closed(depths, creases):
    whole = boxed("a", LOW, HIGH)
    lacking = dict(zip(("a/floor", "a/south"), depths, strict=True))
    faces = tuple(notched(s, lacking[s.name]) if s.name in lacking else s for s in whole.surfaces)
    result = merged(replace(whole, surfaces=faces))
    assert len(result.creases) == creases
    check_creases(result)
    assert whole_mesh(result).is_watertight == (creases == 12)


def receding(surface, depth):
    """The plate, along half of its side v = 0 receding by `depth` metres, in steps that scans leave."""
    at = np.linspace(1.0, 3.5, 26)
    back = depth * np.where(np.arange(26) % 2, 1.0, 0.7)
    more = [(u, v, False) for u, v in zip(at, back, strict=True)]
    return below(surface, (1.0, 0.0, False), *more, (3.5, 0.0, True))


@pytest.mark.parametrize(("depth", "both", "closed"), [(0.08, False, True), (0.08, True, False), (0.15, False, False)])
def test_face_that_ends_just_before_a_crease_is_led_up_to_it_where_the_other_face_ends_in_it(depth, both, closed):
    whole = boxed("a", LOW, HIGH)
    names = {"a/floor", "a/south"} if both else {"a/floor"}
    faces = tuple(receding(s, depth) if s.name in names else s for s in whole.surfaces)
    result = merged(replace(whole, surfaces=faces))
    check_creases(result)
    assert len(result.creases) == (12 if closed else 13)
    assert whole_mesh(result).is_watertight == closed


@pytest.mark.parametrize("high", [0.015, 0.025, 0.06])
def test_narrow_strip_of_a_wall_below_a_cabinet_keeps_its_crease_and_its_area(high):
    whole = boxed("a", LOW, HIGH, ("floor", "south"))
    strip = (3.0, 0.0, False), (3.0, high, False), (1.0, high + 0.002, False), (1.0, 2.5, False)
    cut = below(whole.surfaces[1], *strip)
    loop = cut.trims[0]
    south = replace(cut, trims=(TrimLoop(np.delete(loop.parameters, [5, 6], 0), np.delete(loop.creases, [5, 6])),))
    result = merged(replace(whole, surfaces=(whole.surfaces[0], south)))
    [crease] = result.creases
    assert np.ptp(crease.points[:, 0]) == pytest.approx(3.0, abs=1e-6)
    check_creases(result)
    mesh = tessellate_map(result, 0.002)[[s.name for s in result.surfaces].index("a/south")]
    assert trimesh.Trimesh(mesh.vertices, mesh.triangles).area == pytest.approx(2.5 + 2.0 * high + 0.002, abs=0.003)


def test_walls_that_hardly_bend_meet_between_their_corners():
    """Two walls at six degrees, the second one seen from 3 cm on: no data set saw their edge."""
    first = plate("a/1", (0, 0, 0), (2, 0, 0), (0, 0, 2.5), (2, 1.5), (0, -1, 1, -1))
    second = narrowed(plate("a/2", (2, 0, 0), (2, 0.2, 0), (0, 0, 2.5), (2, 1.5), (2, -1, 3, -1)), 0.03, -1)
    level = np.array([[0, 0], [0.5, 0], [1.0, 0.2 / 3], [1, 1], [0, 1]])
    faces, creases = [first, second], []
    for name, z, marks in (("a/3", 0.0, [0, 2, -1, -1, -1]), ("a/4", 2.5, [1, 3, -1, -1, -1])):
        flat = plate(name, (0, 0, z), (4, 0, 0), (0, 3, 0), (2, 1.5))
        faces.append(BSplineSurface(**{**vars(flat), "trims": (TrimLoop(level, np.array(marks)),)}))
        creases.append(Crease(("a/1", name), np.array([[0, 0, z], [2, 0, z]])))
        creases.append(Crease(("a/2", name), np.array([[2.03, 0.003, z], [4, 0.2, z]])))
    result = merged(map_of(*faces, creases=[creases[k] for k in (0, 2, 1, 3)]))
    assert (len(result.creases), len(result.corners)) == (5, 2)
    assert any(set(crease.surfaces) == {"a/1", "a/2"} for crease in result.creases)
    assert degrees(result).tolist() == [3, 3]
    check_creases(result, 2e-3)  # nearly parallel faces do not tell where along them they meet


def test_crease_that_ends_at_a_wall_gives_its_crease_a_corner():
    """A ramp begins in the middle of a wall: the wall's lower border goes straight on, in two creases."""
    flat = plate("a/1", (0, 0, 0), (2, 0, 0), (0, 3, 0), (2, 1.5), (0, 1, -1, -1))
    ramp = plate("a/2", (2, 0, 0), (2, 0, 0.3), (0, 3, 0), (2, 1.5), (2, -1, -1, 1))
    corners = np.array([[0, 0], [0.5, 0], [1.0, 0.1], [1, 1], [0, 1]])
    wall = plate("a/3", (0, 0, 0), (4, 0, 0), (0, 0, 3), (2, 1.5))
    wall = BSplineSurface(**{**vars(wall), "trims": (TrimLoop(corners, np.array([0, 2, -1, -1, -1])),)})
    creases = [
        Crease(("a/1", "a/3"), np.array([[0, 0, 0], [2, 0, 0.0]])),
        Crease(("a/1", "a/2"), np.array([[2, 0, 0], [2, 3, 0.0]])),
        Crease(("a/2", "a/3"), np.array([[2, 0, 0], [4, 0, 0.3]])),
    ]
    result = merged(map_of(flat, ramp, wall, creases=creases))
    assert (len(result.creases), len(result.corners)) == (3, 1)
    np.testing.assert_allclose(result.corners, [[2, 0, 0]], atol=1e-6)
    assert degrees(result).tolist() == [3]
    check_creases(result)


def curved_corner(names, height=0.1, directions=None):
    """Per data set a wall that bends by `height` over 4 m and the floor before it, and their crease of nine points."""
    x = np.linspace(0.0, 4.0, 9)
    line = np.column_stack([x, height * bow(x), np.zeros(9)])
    faces, creases = [], []
    for number, name in enumerate(names):
        marks = np.where(np.arange(11) < 8, number, -1)
        upright, ground = bowed(wall(f"{name}/1", 0.0, 4.0), height), floor(f"{name}/2", 0.0, 4.0)
        if directions is not None:
            upright = BSplineSurface(
                **{**vars(upright), "covariance": replace(upright.covariance, directions=directions)}
            )
        loops = [
            np.concatenate([np.column_stack([x / 4.0, 0.0 * x]), [[1.0, 1.0], [0.0, 1.0]]]),
            np.concatenate([line[:, :2] / [4.0, 3.0], [[1.0, 1.0], [0.0, 1.0]]]),
        ]
        for surface, parameters in zip((upright, ground), loops, strict=True):
            faces.append(BSplineSurface(**{**vars(surface), "trims": (TrimLoop(parameters, marks),)}))
        creases.append(Crease((f"{name}/1", f"{name}/2"), line))
    return map_of(*faces, creases=creases)


OUTWARDS = (
    np.array([[[0.1, 1.0, 0.0]], [[0.0, 1.0, 0.0]], [[-0.1, 1.0, 0.0]]]) / np.sqrt([1.01, 1.0, 1.01])[:, None, None]
)


@pytest.mark.parametrize(("names", "directions"), [("a", None), ("ab", None), ("a", OUTWARDS)])
def test_crease_at_a_bent_wall_is_one_curve_on_both_faces(names, directions):
    """A bowed face over a plane, of one data set and of two; and a face over another base, which is not joined."""
    result = merged(curved_corner(names, directions=directions))
    (crease,) = result.creases
    x, y, z = crease.points.T
    assert len(x) > 5
    assert np.ptp(x) == pytest.approx(4.0, abs=1e-3)
    np.testing.assert_allclose(z, 0.0, atol=1e-6)
    np.testing.assert_allclose(y, 0.1 * bow(x), atol=2e-5)
    check_creases(result, 2e-5)
    a, b = (
        {tuple(p) for p in mesh.vertices[mesh.vertices[:, 2] < 1e-4].tolist()} for mesh in tessellate_map(result, 2e-4)
    )
    far = {p for p in a | b if p[1] > 0.2}
    assert a - far == b - far
    assert len(a - far) > len(x)


@pytest.mark.parametrize("seen", [2, 1])
@pytest.mark.parametrize("thickness", [0.04, 0.2])
def test_thin_wall_stands_in_a_gap_of_the_floor_that_is_not_closed(thickness, seen):
    """One data set on each side of it; the floor is one plane. Both saw where it stands on it, or only one did."""
    sides = []
    for name, start, end, mark in (("a", 2.0, 0.0, 0), ("b", 2.0 + thickness, 4.0, 1 if seen == 2 else -1)):
        seen_from = ((start + end) / 2, 1.5)
        sides.append(plate(f"{name}/1", (start, 0, 0), (end - start, 0, 0), (0, 3, 0), seen_from, (-1, -1, -1, mark)))
        sides.append(plate(f"{name}/2", (start, 0, 0), (0, 3, 0), (0, 0, 2), seen_from, (mark, -1, -1, -1)))
    creases = [
        Crease((f"{name}/1", f"{name}/2"), np.array([[x, 0.0, 0.0], [x, 3.0, 0.0]]))
        for name, x in (("a", 2.0), ("b", 2.0 + thickness))
    ]
    result = merged(map_of(*sides, creases=creases[:seen]))
    assert len(result.creases) == seen
    check_creases(result, 2e-5)  # the floor is not made larger for less


def test_creases_of_a_room_are_those_of_its_faces():
    result = merged(fit_surfaces(simulated_place("room").cloud, FitParams(method="faces")))
    check_creases(result, 2e-5)
    assert len(result.creases) > 25
    assert np.count_nonzero(degrees(result) >= 3) >= 8


def test_order_of_the_input_does_not_matter():
    one, other = halves(0.002)
    first, second = merged(one, other), merged(other, one)
    assert len(first.corners) == len(second.corners)
    order = [np.lexsort(m.corners.round(6).T) for m in (first, second)]
    np.testing.assert_allclose(first.corners[order[0]], second.corners[order[1]], atol=1e-9)
    pairs = [sorted(tuple(sorted(c.surfaces)) for c in m.creases) for m in (first, second)]
    assert pairs[0] == pairs[1]


def test_extended_surface_is_the_same_where_it_was():
    surface = bowed(wall("a/1", 0.0, 4.0), 0.1)
    low, high = np.array([-0.02, 0.0]), np.array([1.03, 1.1])
    larger = extended(surface, low, high)
    u, v = np.random.default_rng(0).uniform(size=(2, 50))
    moved = ((u - low[0]) / (high[0] - low[0]), (v - low[1]) / (high[1] - low[1]))
    np.testing.assert_allclose(evaluate_surface(larger, *moved), evaluate_surface(surface, u, v), atol=1e-12)
    np.testing.assert_allclose(sensor_covariance(larger, *moved), sensor_covariance(surface, u, v), atol=1e-15)
    np.testing.assert_allclose(evaluate_surface(larger, [1.0], [0.0])[0, 0], 4.0 * high[0])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_extended_surface_goes_on_straight_as_its_height_field_does(degree):
    """A polynomial that goes on leaves the field on which its creases were found."""
    surface = bowed(wall("a/1", 0.0, 4.0), 0.3)
    inner = np.linspace(0.4, 0.8, 3 - degree)
    knots = np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])
    P = np.random.default_rng(degree).normal(0.0, 0.1, (4, 2, 3)) * [0.0, 1.0, 0.0]
    P[..., 0] = 4.0 * np.array([knots[k + 1 : k + 1 + degree].mean() for k in range(4)])[:, None]
    P[:, 1, 2] = 2.5
    covariance = replace(surface.covariance, matrix=np.eye(8))
    surface = replace(surface, degree_u=degree, knots_u=knots, control_points=P, covariance=covariance)
    low, high = np.array([-0.1, 0.0]), np.array([1.2, 1.0])
    larger, field = extended(surface, low, high), field_of(surface)
    uv = np.column_stack([np.linspace(low[0], high[0], 40), np.linspace(0.0, 1.0, 40)])
    at = evaluate_surface(larger, *((uv - low) / (high - low)).T)
    np.testing.assert_allclose(at, places_on(field, uv), atol=1e-9)
