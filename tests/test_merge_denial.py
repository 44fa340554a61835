"""Faces that other data sets deny, and faces that lie on others: every place is in the map once."""

import numpy as np
import pytest
from face_maps import map_of, wall
from shapely import intersection, transform

from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.bases import based_face
from bsmap_cli.merge.denial import REASON
from bsmap_cli.params import MergeParams

LEANING = np.array([[0.0, 0.0], [0.06, 0.06]])
POSE = np.diag([1e-6, 1e-6, 1e-8])


def merged(*maps):
    return merge_surfaces(list(maps), MergeParams())


def leaning(name="c/1"):
    """Half a metre that nobody else saw, and half a metre of the walls of `walls`, at 3.4 degrees to them."""
    return wall(name, 3.5, 4.5, noise=LEANING, pose=POSE)


def walls(*names):
    return [wall(f"{name}/1", 0.0, 4.0, pose=POSE) for name in names]


def shared_area(one, other):
    """Square metres that two walls along x have in common."""
    return intersection(*(region_along_x(surface) for surface in (one, other))).area


def region_along_x(surface):
    face = based_face(surface)
    return transform(face.region, lambda st: face.field.base.place(np.column_stack([st, 0.0 * st[:, 0]]))[:, [0, 2]])


@pytest.mark.parametrize("sets", ["ab", "abd"])
def test_face_that_leans_on_what_more_data_sets_saw_is_left_out(sets):
    result = merged(map_of(*walls(*sets), leaning()))
    (one,) = result.surfaces
    assert "c" not in one.data_sets
    (told,) = [d for d in result.decisions if d.reason == REASON]
    assert (told.first, told.second, told.outcome) == ("c/1", "", "refused")
    assert 0.0 < told.figures["denied"] <= 1.0


def test_of_two_data_sets_the_one_that_knows_less_is_denied():
    rough = leaning()
    covariance = type(rough.covariance)(
        rough.covariance.directions, 9.0 * rough.covariance.matrix, rough.covariance.pose
    )
    rough = type(rough)(**{**vars(rough), "covariance": covariance})
    (one,) = merged(map_of(*walls("a"), rough)).surfaces
    assert one.data_sets == ("a",)


def test_what_leans_in_another_survey_stays():
    result = merged(map_of(*walls("a", "b")), map_of(leaning()))
    assert len(result.surfaces) == 2
    assert not [d for d in result.decisions if d.reason == REASON]


def test_wall_that_lies_apart_at_its_end_stays_without_what_others_saw():
    """An offset may be an error of the pose: the wall ends where the other begins, and nothing is there twice."""
    result = merged(map_of(*walls("a", "b"), wall("c/1", 3.5, 8.0, offset=0.025, pose=POSE)))
    assert len(result.surfaces) == 2
    areas = sorted(based_face(surface).area for surface in result.surfaces)
    assert areas == pytest.approx([10.0, 10.0], abs=0.01)
    assert shared_area(*result.surfaces) < 1e-4


def test_panel_of_four_centimetres_is_not_cut_off_the_wall_behind_it():
    result = merged(map_of(*walls("a", "b"), wall("c/1", 3.9, 8.0, offset=0.04, pose=POSE)))
    assert sum(based_face(surface).area for surface in result.surfaces) == pytest.approx(20.25, abs=0.01)


def test_old_map_may_show_one_place_twice():
    """Both states of what moved stay in a map, whatever is folded into it."""
    old = merged(map_of(*walls("a", "b")), map_of(wall("c/1", 0.0, 4.0, offset=0.02, pose=POSE)))
    assert len(old.surfaces) == 2
    again = merged(old, map_of(*walls("d")))
    assert len(again.surfaces) == 2


def test_order_of_the_faces_does_not_matter():
    faces = [*walls("a", "b"), leaning(), wall("d/1", 3.5, 8.0, offset=0.025, pose=POSE)]
    one, other = (merged(map_of(*some)) for some in (faces, faces[::-1]))
    for a, b in zip(one.surfaces, other.surfaces, strict=True):
        assert a.name == b.name
        np.testing.assert_allclose(a.control_points, b.control_points, atol=1e-9)


def test_thin_sheet_on_a_wall_is_there_once_though_one_data_set_saw_the_wall_through_it():
    """1.5 cm before the wall; its scans left it out, and the wall between them was taken for seen."""
    hole = [((1.0, 0.5), (2.0, 1.5))]
    around = [wall(f"{name}/1", 0.0, 4.0, pose=POSE, holes=hole) for name in "ab"]
    sheets = [wall(f"{name}/2", 1.0, 2.0, heights=(0.5, 1.5), offset=0.015, pose=POSE) for name in "ab"]
    result = merged(map_of(*around, *sheets, wall("c/1", 0.0, 4.0, pose=POSE)))
    large, small = sorted(result.surfaces, key=lambda surface: -based_face(surface).area)
    assert based_face(large).area == pytest.approx(9.0, abs=0.01)
    assert based_face(small).area == pytest.approx(1.0, abs=0.01)
    assert np.abs(small.control_points[..., 1] - 0.015).max() < 0.001
