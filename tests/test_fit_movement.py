"""Division of trajectories into translations and rotations."""

from itertools import pairwise

import numpy as np
import pytest

from bsmap_cli.core import se2
from bsmap_cli.fit.movement import divide

FORWARD = (0.1, 0.0, 0.0)
LEFT = (0.0, 0.0, 0.087)


def drive(*legs):
    """Poses after legs of (step, count), from the origin; step (x, y, theta) in the robot's frame."""
    poses = [np.zeros(3)]
    for step, count in legs:
        for _ in range(count):
            poses.append(se2.compose(poses[-1], np.array(step)))
    return np.array(poses)


def described(poses, set_length=5.0):
    return [(m.kind, int(m.scans[0]), int(m.scans[-1])) for m in divide(poses, set_length)]


def noisy(poses, seed=0):
    """Millimetres and tenths of degrees, as poses from slam have."""
    return poses + np.random.default_rng(seed).normal(size=poses.shape) * [0.003, 0.003, 0.003]


@pytest.mark.parametrize("noise", [False, True])
def test_steps_and_turns_alternate_and_share_their_joints(noise):
    poses = drive((FORWARD, 19), (LEFT, 18), (FORWARD, 19))
    expected = [("translation", 0, 19), ("rotation", 19, 37), ("translation", 37, 56)]
    assert described(noisy(poses) if noise else poses) == expected


def test_standing_still_adds_no_scans():
    poses = noisy(drive((FORWARD, 10), ((0.0, 0.0, 0.0), 200), (FORWARD, 10)))
    (movement,) = divide(poses, 5.0)
    assert movement.kind == "translation"
    assert len(movement.scans) <= 23


def test_robot_that_never_moves_gives_no_set():
    assert described(noisy(np.zeros((50, 3)))) == []
    assert described(np.zeros((1, 3))) == []
    assert described(np.zeros((0, 3))) == []


@pytest.mark.parametrize(("step", "kind"), [((0.05, 0.0, 0.02), "translation"), ((0.01, 0.0, 0.06), "rotation")])
def test_arcs_count_by_the_radius_of_their_turn(step, kind):
    assert {m.kind for m in divide(noisy(drive((step, 40))), 5.0)} == {kind}


def test_rotation_is_split_beyond_half_a_turn():
    movements = divide(drive((LEFT, 72)), 5.0)  # 359 degrees
    assert sorted(len(m.scans) for m in movements) in ([37, 37], [36, 38])
    assert len(divide(drive((LEFT, 36)), 5.0)) == 1  # 179 degrees


def test_rotation_back_is_a_set_of_its_own():
    back = (0.0, 0.0, -0.087)
    assert described(drive((LEFT, 15), (back, 15))) == [("rotation", 0, 15), ("rotation", 15, 30)]


def test_long_translation_is_divided_into_equal_parts():
    movements = divide(drive((FORWARD, 120)), 5.0)
    assert [len(m.scans) for m in movements] == [41, 41, 41]
    assert all(a.scans[-1] == b.scans[0] for a, b in pairwise(movements))


def test_wide_arc_is_cut_at_a_quarter_turn():
    movements = divide(drive(((0.1, 0.0, 0.05), 100)), 50.0)
    assert all(m.kind == "translation" for m in movements)
    assert all(np.sum(0.05 * np.ones(len(m.scans) - 1)) < 1.1 * np.pi / 2 for m in movements)


def test_single_odd_step_does_not_break_a_set():
    poses = drive((FORWARD, 8), ((0.01, 0.0, 0.03), 1), (FORWARD, 8))
    assert described(poses) == [("translation", 0, 17)]


def test_jump_ends_a_set():
    poses = drive((FORWARD, 8), ((5.0, 0.0, 0.0), 1), (FORWARD, 8))
    assert described(poses) == [("translation", 0, 8), ("translation", 9, 17)]


def test_continuous_run_with_noise_keeps_its_legs():
    leg, turn = (0.05, 0.0, 0.0), (0.0, 0.0, 0.06)
    poses = noisy(drive((leg, 60), (turn, 26), (leg, 60)))
    assert [m.kind for m in divide(poses, 5.0)] == ["translation", "rotation", "translation"]
