"""Outlines of the map do not double back on themselves, nor cross."""

import numpy as np
import pytest
from face_maps import floor, map_of, plate

from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.bases import based_face, field_of
from bsmap_cli.merge.curves import Curve
from bsmap_cli.merge.rings import Knots, Loop, Ring, put_together
from bsmap_cli.merge.runs import Meeting, Run
from bsmap_cli.merge.topology import Edge, Topology, without_twice
from bsmap_cli.merge.tracing import EVERYWHERE
from bsmap_cli.merge.untangling import untangled
from bsmap_cli.model import Crease
from bsmap_cli.params import MergeParams

FIELD = field_of(floor("a/1", 0.0, 4.0))


def ring(points, edges=None):
    flat = np.asarray(points, dtype=float)
    numbers = np.full(len(flat), -1) if edges is None else np.array(edges)
    return Ring(np.column_stack([flat, np.zeros(len(flat))]), numbers)


def test_outline_does_not_double_back_along_its_crease():
    back = ring([(0, 0), (3, 0), (2.992, 0.0003), (3, 2), (0, 2)], [7, -1, -1, -1, -1])
    (one,) = untangled([back], FIELD)
    np.testing.assert_array_equal(one.points[:, :2], [(0, 0), (3, 0), (3, 2), (0, 2)])
    np.testing.assert_array_equal(one.edges, [7, -1, -1, -1])


def test_spike_is_cut_off_and_a_narrow_strip_is_not():
    spike = ring([(0, 0), (3, 0), (3, 1), (3.4, 1.001), (3, 1.002), (3, 2), (0, 2)])
    assert len(untangled([spike], FIELD)[0].points) == 6
    strip = ring([(0, 0), (3, 0), (3, 0.02), (0, 0.02)])
    assert len(untangled([strip], FIELD)[0].points) == 4


def test_crossing_sides_are_made_simple_by_what_no_crease_holds():
    crossed = ring([(0, 0), (3, 0), (3, 2), (1.5, -0.2), (0, 2)], [3, -1, -1, -1, -1])
    (one,) = untangled([crossed], FIELD)
    np.testing.assert_array_equal(one.points[:, :2], [(0, 0), (3, 0), (3, 2), (0, 2)])


def test_hole_does_not_cross_the_outline_around_it():
    outer, hole = ring([(0, 0), (3, 0), (3, 2), (0, 2)]), ring([(1, 1), (1, 1.5), (1.2, 2.1), (1.4, 1.5), (1.4, 1)])
    whole, inner = untangled([outer, hole], FIELD)
    assert len(whole.points) == 4
    np.testing.assert_array_equal(inner.points[:, :2], [(1, 1), (1, 1.5), (1.4, 1.5), (1.4, 1)])


def test_what_creases_hold_stays_as_it_is():
    held = ring([(0, 0), (3, 0), (2.992, 0.0003), (3, 2), (0, 2)], [1, 2, 3, 4, 5])
    assert untangled([held], FIELD)[0].points is held.points


@pytest.mark.parametrize("width", [0.05, 0.09, 0.15])
def test_strip_of_wall_between_floor_and_ceiling_keeps_its_width(width):
    """The reveal of a door: both of its long borders are near the crease at one of them."""
    strip = plate("a/1", (0, 0, 0), (0, width, 0), (0, 0, 2), (2, 0.5), (0, -1, 1, 2))
    wall = plate("a/2", (0, 0, 0), (3, 0, 0), (0, 0, 2), (2, 1.5), (3, -1, 4, 2))
    flat = [
        plate(f"a/{3 + k}", (0, 0, z), (3, 0, 0), (0, 3, 0), (2, 1.5), (3 + k, -1, -1, k)) for k, z in enumerate((0, 2))
    ]
    lines = [
        Crease(("a/1", "a/3"), np.array([[0, 0, 0], [0, width, 0.0]])),
        Crease(("a/1", "a/4"), np.array([[0, 0, 2], [0, width, 2.0]])),
        Crease(("a/1", "a/2"), np.array([[0, 0, 0], [0, 0, 2.0]])),
        Crease(("a/2", "a/3"), np.array([[0, 0, 0], [3, 0, 0.0]])),
        Crease(("a/2", "a/4"), np.array([[0, 0, 2], [3, 0, 2.0]])),
    ]
    result = merge_surfaces([map_of(strip, wall, *flat, creases=lines)], MergeParams())
    areas = {surface.name: based_face(surface).area for surface in result.surfaces}
    assert areas["a/1"] == pytest.approx(2.0 * width, abs=1e-3)


def test_edge_along_which_one_face_runs_twice_is_none():
    """A hole that touches the outline along a crease: there the face ends at no crease."""
    square = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]])
    hole = np.array([[2.0, 0, 0], [1, 0, 0], [1.5, 0.5, 0]])
    edges = [Edge((0, 1), square[k : k + 2], (-1, -1)) for k in (0, 1)]
    rings = {0: [Ring(square, np.array([0, 1, -1, -1, -1])), Ring(hole, np.array([1, -1, -1]))]}
    rings[1] = [Ring(square[:, [0, 2, 1]], np.array([0, 1, -1, -1, -1]))]
    found = without_twice(Topology(rings, edges, np.zeros((0, 3))))
    assert len(found.edges) == 1
    assert [ring.edges.tolist() for ring in found.rings[0]] == [[0, -1, -1, -1, -1], [-1, -1, -1]]
    assert found.rings[1][0].edges.tolist() == [0, -1, -1, -1, -1]


def test_loop_whose_runs_all_end_in_one_corner_stays_as_it_was():
    points = np.array([[0.0, 0, 0], [0.02, 0, 0], [0.0, 0.02, 0]])
    ways = np.eye(3)[:2]
    curves = [
        Curve((0, k + 1), np.stack([0.0 * way, way]), np.array([0.0, 1.0]), EVERYWHERE) for k, way in enumerate(ways)
    ]
    knots = [Knots(np.zeros(1), np.zeros(1, dtype=int), np.zeros((1, 3)))] * 2
    runs = [Run(0, 0, 1, 0.0, 0.02), Run(1, 2, 0, 0.02, 0.0)]
    meetings = [Meeting(k, 1 - k, (0, 1, 2), np.zeros(3)) for k in (0, 1)]
    loop = Loop(0, points, runs, meetings, np.zeros((2, 2), dtype=int))
    found = put_together(loop, curves, knots, {})
    np.testing.assert_array_equal(found.points, points)
    assert found.edges.tolist() == [-1, -1, -1]
