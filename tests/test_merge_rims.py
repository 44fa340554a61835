"""Rims of the map: where data sets bracket one edge, the border runs in the middle of their brackets."""

from dataclasses import replace

import numpy as np
import pytest
from face_maps import map_of, wall

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.trims import rims_of
from bsmap_cli.evaluate import surface_samples
from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.model import TrimLoop
from bsmap_cli.params import MergeParams

PLACES = np.array([1.98, 2.01, 1.99, 2.02, 2.0])


def ended(name, end, width=0.04, side=1, spike=None):
    """Wall from 0 to `end` whose one side is a rim: 1 at the end, 3 at the beginning. spike : metres beyond the end."""
    made = wall(name, 0.0, end)
    loop = made.trims[0]
    rims = np.zeros(4)
    rims[side] = width
    loop = replace(loop, rims=rims)
    if spike is not None:
        made = wall(name, 0.0, end + spike)
        at = end / (end + spike)
        corners = np.array([[0, 0], [at, 0], [at, 0.5], [1.0, 0.51], [at, 0.52], [at, 1], [0, 1]])
        loop = replace(loop, parameters=corners, creases=np.full(7, -1), rims=np.array([0, *[width] * 4, 0, 0]))
    return replace(made, trims=(loop,))


def merged(*surfaces):
    return merge_surfaces([map_of(*surfaces)], MergeParams())


def the_rim(result):
    (surface,) = result.surfaces
    (rim,) = rims_of(surface)
    return rim


def test_a_rim_runs_in_the_middle_of_the_brackets():
    result = merged(*(ended(f"set-{k}/1", x) for k, x in enumerate(PLACES)))
    rim = the_rim(result)
    np.testing.assert_allclose(rim.points[:, 0], 2.0, atol=0.006)
    np.testing.assert_allclose(np.sort(rim.points[:, 2]), [0.0, 2.5], atol=1e-5)
    assert rim.width == pytest.approx(0.04)
    assert surface_samples(result, 0.1)[:, 0].max() < 2.006


def test_a_notch_that_all_leave_open_is_no_rim():
    # 35 mm deep and 7 cm high: its sides stay near the rim, but no data set tells of an edge that goes their way.
    corners = np.array([[0, 0], [1, 0], [1, 0.486], [0.9825, 0.5], [1, 0.514], [1, 1], [0, 1]])
    rims = np.array([0, 0.04, 0, 0, 0.04, 0, 0])
    walls = [wall(f"set-{k}/1", 0.0, 2.0) for k in range(3)]
    result = merged(*(replace(w, trims=(TrimLoop(corners, np.full(7, -1), rims),)) for w in walls))
    (surface,) = result.surfaces
    points = np.concatenate([rim.points for rim in rims_of(surface)])
    np.testing.assert_allclose(points[:, 0], 2.0, atol=0.005)
    assert np.ptp(points[:, 2]) == pytest.approx(2.5, abs=1e-3)
    assert not np.any(np.abs(points[:, 2] - 1.25) < 0.02)
    corner = evaluate_surface(surface, *surface.trims[0].parameters.T)
    assert np.linalg.norm(corner[:, [0, 2]] - [1.965, 1.25], axis=1).min() < 0.02


def test_the_order_of_the_input_does_not_matter():
    surfaces = [ended(f"set-{k}/1", x) for k, x in enumerate(PLACES)]
    one, other = the_rim(merged(*surfaces)), the_rim(merged(*surfaces[::-1]))
    np.testing.assert_allclose(one.points, other.points, atol=1e-9)


def test_a_spike_of_one_data_set_is_cut():
    result = merged(*(ended(f"set-{k}/1", 2.0) for k in range(3)), ended("set-3/1", 2.0, spike=0.05))
    assert surface_samples(result, 0.02)[:, 0].max() < 2.005
    np.testing.assert_allclose(the_rim(result).points[:, 0], 2.0, atol=0.005)


def test_what_another_data_set_saw_farther_on_is_no_rim():
    result = merged(ended("set-0/1", 2.0), wall("set-1/1", 0.0, 3.0))
    assert [rim for surface in result.surfaces for rim in rims_of(surface)] == []
    assert surface_samples(result, 0.1)[:, 0].max() == pytest.approx(3.0, abs=1e-6)


def test_the_border_on_the_other_side_of_a_narrow_face_is_not_its_rim():
    # 4 cm wide, its end a rim: the beginning lies within reach of that, but the face lies on its other side.
    narrow = [wall(f"set-{k}/1", 1.96, 2.0) for k in range(2)]
    rims = np.array([0.0, 0.02, 0.0, 0.0])
    narrow = [replace(w, trims=(replace(w.trims[0], rims=rims),)) for w in narrow]
    rim = the_rim(merged(*narrow))
    np.testing.assert_allclose(rim.points[:, 0], 2.0, atol=1e-6)


def test_a_map_that_is_folded_in_keeps_its_rims(tmp_path):
    first = merged(*(ended(f"set-{k}/1", x) for k, x in enumerate(PLACES)))
    write_surfaces(tmp_path / "a.map.json.gz", first)
    read = read_surfaces(tmp_path / "a.map.json.gz")
    np.testing.assert_allclose(the_rim(read).points, the_rim(first).points, atol=1e-3)
    again = merge_surfaces([read, map_of(ended("set-9/1", 2.01))], MergeParams())
    np.testing.assert_allclose(the_rim(again).points[:, 0], 2.0, atol=0.008)


def test_a_face_smaller_than_its_brackets_stays_a_face():
    small = [wall(f"set-{k}/1", 0.0, 0.03, heights=(0.0, 0.04)) for k in range(2)]
    small = [replace(w, trims=(replace(w.trims[0], rims=np.full(4, 0.05)),)) for w in small]
    (surface,) = merged(*small).surfaces
    assert all(len(loop.parameters) > 2 for loop in surface.trims)
