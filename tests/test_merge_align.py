"""Maps of different origin brought together: where they belong, and refused where that cannot be told."""

from dataclasses import replace

import numpy as np
import pytest
from face_maps import ROOM, ROOM_POSE, boxed, map_of, plate, put, room, with_poses

from bsmap_cli.core import se2
from bsmap_cli.core.uncertainty import surface_covariance
from bsmap_cli.errors import ParameterError, PlacementError
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.placed import placed
from bsmap_cli.model import PosePart
from bsmap_cli.params import MergeParams

ALIGN = MergeParams(align=True)


def missed(placement, x, y, degrees):
    """(3,) what a placement leaves of the move of the second of two maps, whichever of them was placed."""
    true = np.array([x, y, np.radians(degrees)])
    return se2.compose(placement.pose, true) if placement.survey == 1 else se2.between(placement.pose, true)


def levels(surface_map):
    """Sorted middles (n, 3) of all faces."""
    middles = np.array([s.control_points.reshape(-1, 3).mean(axis=0) for s in surface_map.surfaces])
    return middles[np.lexsort(middles.round(2).T)]


@pytest.mark.parametrize(
    ("x", "y", "degrees"),
    [(4.0, -7.0, 0.0), (-3.0, 2.0, 180.0), (12.0, 5.0, 37.0), (0.5, 0.0, -90.0), (1.0, 9.0, 263.0)],
)
def test_survey_of_another_origin_finds_its_place(x, y, degrees):
    away = placed(room("set-02", 0.002, 1), put(x, y, degrees))
    result = merge_surfaces([room("set-01", 0.002, 0), away], ALIGN)
    (placement,) = result.placements
    np.testing.assert_allclose(missed(placement, x, y, degrees), 0.0, atol=0.006)
    assert placement.verdict == "unique"
    assert placement.rival < 0.8
    assert placement.matched > 40.0
    at_once = merge_surfaces([room("set-01", 0.002, 0), room("set-02", 0.002, 1)], MergeParams())
    assert len(result.surfaces) == len(at_once.surfaces) == 8
    assert all(len(surface.data_sets) == 2 for surface in result.surfaces)
    if placement.survey == 1:
        np.testing.assert_allclose(levels(result), levels(at_once), atol=0.006)


def test_floors_tell_the_height():
    result = merge_surfaces([room("set-01"), placed(room("set-02"), put(3.0, 1.0, 120.0, height=0.3))], ALIGN)
    assert abs(result.placements[0].height) == pytest.approx(0.3, abs=1e-3)
    assert len(result.surfaces) == 8


def test_empty_room_is_the_same_half_a_turn_on_and_refused():
    away = placed(room("set-02", extra=False), put(2.0, 1.0, 30.0))
    with pytest.raises(PlacementError, match=r"map 2: it could lie at x .* or at x .*: the second scores 100% of the"):
        merge_surfaces([room("set-01", extra=False), away], ALIGN)


def test_bare_corridor_could_slide_and_is_refused():
    low, high = (0.0, 0.0, 0.0), (15.0, 2.0, 2.5)
    sides = ("floor", "ceiling", "south", "north")
    one = with_poses(boxed("set-01", low, high, sides))
    niche = plate("set-01/niche", (5.0, 1.8, 0.0), (2.0, 0.0, 0.0), (0.0, 0.0, 2.5), (7.0, 1.0))
    one = replace(one, surfaces=(*one.surfaces, niche))
    other = placed(with_poses(boxed("set-02", (0.0, 0.0, 0.0), (9.0, 2.0, 2.5), sides)), put(1.0, 2.0, 10.0))
    with pytest.raises(
        PlacementError, match=r"it could slide or turn along the others: only 0\.00 m2 of walls hold it"
    ):
        merge_surfaces([one, other], ALIGN)


def test_other_room_is_refused():
    hall = placed(boxed("set-02", (0.0, 0.0, 0.0), (11.0, 9.0, 4.0)), put(0.0, 0.0, 45.0))
    with pytest.raises(PlacementError, match=r"do not overlap|could lie at"):
        merge_surfaces([room(), hall], ALIGN)
    part = boxed("set-02", (0.0, 0.0, 0.0), (1.2, 0.9, 2.5))
    with pytest.raises(PlacementError, match="they do not overlap"):
        merge_surfaces([room(), part], ALIGN)


def test_map_without_walls_is_refused():
    with pytest.raises(PlacementError, match=r"map 2: it has no surfaces that could tell its place"):
        merge_surfaces([room(), map_of()], ALIGN)
    floor = map_of(plate("set-02/floor", (0.0, 0.0, 0.0), (4.0, 0.0, 0.0), (0.0, 4.0, 0.0), (2.0, 2.0)))
    with pytest.raises(PlacementError, match=r"they do not overlap"):
        merge_surfaces([room(), floor], ALIGN)


def test_one_map_alone_is_refused():
    with pytest.raises(ParameterError, match="align: one map alone"):
        merge_surfaces([room()], ALIGN)


def test_maps_follow_one_after_the_other():
    """The third overlaps with the second one only: two rooms with a door between them."""

    def two(data_set, first, second):
        parts, creases = [], ()
        if first:
            parts, creases = list(room(data_set).surfaces), room(data_set).creases
        if second:
            parts += [
                plate(f"{data_set}-b/{k}", *sides, (9.0, 1.5))
                for k, sides in enumerate([
                    ((6.2, 0.0, 0.0), (5.0, 0.0, 0.0), (0.0, 3.0, 0.0)),
                    ((6.2, 0.0, 0.0), (5.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
                    ((6.2, 3.0, 0.0), (5.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
                    ((11.2, 0.0, 0.0), (0.0, 3.0, 0.0), (0.0, 0.0, 3.0)),
                    ((6.2, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 3.0)),
                    ((8.0, 2.5, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 3.0)),
                ])
            ]  # fmt: skip
        return with_poses(map_of(*parts, creases=creases))

    maps = [two("set-01", True, True), two("set-02", False, True), two("set-03", True, False)]
    away = [maps[0], placed(maps[1], put(3.0, 4.0, 70.0)), placed(maps[2], put(-5.0, 1.0, 200.0))]
    result = merge_surfaces(away, ALIGN)
    assert len(result.placements) == 2
    assert len(result.surfaces) == 14


def test_input_order_does_not_matter():
    one, other = room("set-01", 0.002, 0), placed(room("set-02", 0.002, 1), put(-4.0, 3.0, 100.0))
    a, b = merge_surfaces([one, other], ALIGN), merge_surfaces([other, one], ALIGN)
    assert {a.placements[0].survey, b.placements[0].survey} == {0, 1}
    np.testing.assert_allclose(levels(a), levels(b), rtol=0, atol=1e-9)


def test_map_keeps_its_frame_however_many_data_sets_the_survey_has():
    old = merge_surfaces([room("set-01"), room("set-02")], MergeParams())
    survey = merge_surfaces([room("set-01")], MergeParams())
    survey = replace(survey, data_sets=tuple(replace(survey.data_sets[0], name=f"set-0{k}") for k in (1, 2, 3)))
    result = merge_surfaces([placed(survey, put(2.0, 2.0, 50.0)), old], ALIGN)
    assert [p.survey for p in result.placements] == [0]
    np.testing.assert_allclose(levels(result), levels(old), atol=1e-3)


def test_covariance_turns_with_its_surface_and_bears_the_error_of_the_placement():
    made = room()
    error = np.diag([0.01**2, 0.02**2, 0.003**2])
    put_there = put(3.0, -2.0, 65.0, covariance=error)
    exact, there = placed(made, put(3.0, -2.0, 65.0)), placed(made, put_there)
    c, s = np.cos(np.radians(65.0)), np.sin(np.radians(65.0))
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    at = np.array([0.2]), np.array([0.7])
    for before, turned, after in zip(made.surfaces, exact.surfaces, there.surfaces, strict=True):
        C = R @ surface_covariance(before, *at)[0] @ R.T
        np.testing.assert_allclose(surface_covariance(turned, *at)[0], C, atol=1e-15)
        P = turned.control_points
        point = (P[0, 0] + 0.2 * (P[1, 0] - P[0, 0]) + 0.7 * (P[0, 1] - P[0, 0]))[:2] - [3.0, -2.0]
        J = np.array([[1.0, 0.0, -point[1]], [0.0, 1.0, point[0]], [0.0, 0.0, 0.0]])
        np.testing.assert_allclose(surface_covariance(after, *at)[0], C + J @ error @ J.T, atol=1e-15)


def test_data_sets_of_a_placed_map_err_together():
    parts = {
        name: PosePart(name, np.array([x, 1.0]), ROOM_POSE, modes=np.diag([1e-3, 0.0, 0.0]), trajectory="t")
        for name, x in (("a", 0.0), ("b", 5.0))
    }
    faces = boxed("a", *ROOM).surfaces[0], boxed("b", *ROOM).surfaces[1]
    faces = tuple(
        replace(f, covariance=replace(f.covariance, pose=(parts[f.data_sets[0]],))) for f in faces
    )  # fmt: skip
    there = placed(map_of(*faces), put(0.0, 0.0, 0.0, covariance=np.diag([0.01**2, 0.02**2, 0.0])))
    a, b = (surface.covariance.pose[0] for surface in there.surfaces)
    assert a.trajectory == b.trajectory != "t"
    np.testing.assert_allclose(a.modes @ b.modes.T, np.diag([1e-6 + 0.01**2, 0.02**2, 0.0]), atol=1e-12)
    np.testing.assert_allclose(a.covariance, ROOM_POSE + np.diag([0.01**2, 0.02**2, 0.0]), atol=1e-12)
