"""Trim loops as whole numbers: they come back, and creases leave hardly anything of their vertices to be told."""

import numpy as np
import pytest

from bsmap_cli.io.trim_loops import pack_loop, sheet_of, unpack_loop
from bsmap_cli.model import TrimLoop

TURN = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])


def net(s=3.0, t=0.7):
    """Control points of a plane, s by t metres, turned."""
    P = np.zeros((2, 2, 3))
    P[1, :, 0], P[:, 1, 1] = s, t
    return P @ TURN.T + [1.0, 2.0, 3.0]


def at(uv):
    """Points (n, 3) of the plane."""
    return np.column_stack([np.asarray(uv) * [3.0, 0.7], np.zeros(len(uv))]) @ TURN.T + [1.0, 2.0, 3.0]


def checked(loop, sheet, lines):
    """Numbers and creases of a loop, which come back and are written alike again."""
    numbers, creases = pack_loop(loop, sheet, lines)
    back = unpack_loop(numbers.astype(float), creases, sheet, lines)
    assert np.abs((back.parameters - loop.parameters) * sheet.steps).max() <= 0.5 + 1e-9
    np.testing.assert_array_equal(back.creases, loop.creases)
    again = pack_loop(back, sheet, lines)
    np.testing.assert_array_equal(again[0], numbers)
    np.testing.assert_array_equal(again[1], creases)
    return numbers, creases


def test_parameters_have_two_steps_a_millimetre_and_reach_one():
    sheet = sheet_of(net())
    assert sheet.steps.tolist() == [6000.0, 1400.0]
    loop = TrimLoop(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0]]), np.full(3, -1))
    numbers, creases = checked(loop, sheet, [])
    assert numbers.tolist() == [[0, 0], [6000, 0], [0, 1400]]
    assert creases.tolist() == [0, 0, 0]


def test_surface_without_extent_has_one_step():
    assert sheet_of(np.zeros((2, 2, 3))).steps.tolist() == [1.0, 1.0]


@pytest.mark.parametrize("backwards", [False, True])
@pytest.mark.parametrize("shift", range(6))
def test_vertices_along_creases_are_told_by_them(backwards, shift):
    """A crease of three sides, one of one side that goes on from it, open sides; from whichever vertex on."""
    uv = np.array([[0.1, 0.2], [0.3, 0.21], [0.5, 0.25], [0.9, 0.2], [0.9, 0.9], [0.2, 0.8]])
    way = slice(None, None, -1 if backwards else 1)
    lines = [np.zeros((2, 3)), at(uv[:4])[way], at(uv[3:5])[way]]
    loop = TrimLoop(np.roll(uv, shift, axis=0), np.roll([1, 1, 1, 2, -1, -1], shift))
    numbers, creases = checked(loop, sheet_of(net()), lines)
    sign = -1 if backwards else 1
    np.testing.assert_array_equal(np.roll(creases, -shift), [2 * sign] * 3 + [3 * sign, 0, 0])
    assert np.abs(np.roll(numbers, -shift, axis=0)[:5]).max() <= 1


def test_crease_that_a_loop_follows_only_in_part_tells_nothing():
    uv = np.array([[0.1, 0.2], [0.3, 0.2], [0.5, 0.9]])
    line = at([[0.0, 0.2], [0.1, 0.2], [0.3, 0.2]])
    numbers, creases = checked(TrimLoop(uv, np.array([0, -1, -1])), sheet_of(net()), [line])
    assert creases.tolist() == [1, 0, 0]
    assert numbers.tolist() == [[600, 280], [1200, 0], [1200, 980]]


def test_loop_along_one_closed_crease():
    uv = np.array([[0.1, 0.2], [0.9, 0.2], [0.9, 0.8], [0.1, 0.8]])
    line = at(np.concatenate([uv, uv[:1]]))
    numbers, _ = checked(TrimLoop(uv, np.zeros(4, dtype=int)), sheet_of(net()), [line])
    assert np.abs(numbers).max() <= 1
