"""Winding numbers and simplified lines."""

import numpy as np

from bsmap_cli.core.polygons import signed_area, simplify, winding_number

SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def test_hole_run_around_clockwise_is_outside():
    hole = (0.25 + 0.5 * SQUARE)[::-1]
    inside = winding_number(np.array([[0.1, 0.1], [0.5, 0.5], [1.5, 0.5]]), [SQUARE, hole])
    assert inside.tolist() == [1, 0, 0]


def test_overlapping_loops_count_twice():
    assert winding_number(np.array([[0.75, 0.75], [0.1, 0.1]]), [SQUARE, SQUARE + 0.5]).tolist() == [2, 1]


def test_winding_number_is_the_sum_of_angles():
    """The slow twin: the angle that the polygon turns through as seen from the point."""
    rng = np.random.default_rng(0)
    polygon, points = rng.random((9, 2)), rng.random((200, 2))
    ends = polygon[None] - points[:, None]
    angle = np.arctan2(ends[..., 1], ends[..., 0])
    turn = (np.diff(angle, axis=1, append=angle[:, :1]) + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_array_equal(winding_number(points, [polygon]), np.rint(turn.sum(axis=1) / (2 * np.pi)))


def test_simplified_line_stays_within_the_tolerance():
    x = np.linspace(0.0, 3.0, 200)
    line = np.column_stack([x, np.sin(2.0 * x)])
    kept = simplify(line, 0.01)
    assert kept[0]
    assert kept[-1]
    assert kept.sum() < 25
    off = np.abs(np.interp(x, x[kept], line[kept, 1]) - line[:, 1])
    assert off.max() < 0.03


def test_straight_line_keeps_its_ends_only():
    assert simplify(np.linspace([0.0, 0.0, 0.0], [1.0, 2.0, 3.0], 50), 1e-9).sum() == 2


def test_area_is_positive_counter_clockwise_and_keeps_its_digits_far_from_the_origin():
    both = np.stack([2.0 * SQUARE, 2.0 * SQUARE[::-1]])
    np.testing.assert_array_equal(signed_area(both), [4.0, -4.0])
    np.testing.assert_array_equal(signed_area(both + 1e9), [4.0, -4.0])
