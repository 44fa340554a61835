"""Lines that are far and unseen leave the filter's state and come back as they were."""

import numpy as np

from bsmap_cli.slam import filter
from bsmap_cli.slam.shelf import REACH, UNSEEN, distances, empty_shelf, look_around
from bsmap_cli.slam.upkeep import Landmarks

NOISE = np.diag([0.001, 0.01]) ** 2


def state_with_two_walls():
    state = filter.initial_state()
    for r in (2.0, 3.0):
        state = filter.augment(state, np.array([0.0, r]), NOISE)
    return state, Landmarks(np.array([[-1.0, 1.0], [-1.0, 1.0]]), np.array([5, 5]), np.array([0, 0]))


def test_distance_is_to_the_nearest_point_of_the_segment():
    lines, extents = np.array([[0.0, 2.0], [0.0, 2.0]]), np.array([[-1.0, 1.0], [3.0, 5.0]])
    assert np.allclose(distances(np.zeros(3), lines, extents), [2.0, np.hypot(2.0, 3.0)])


def test_far_lines_leave_the_state_and_come_back_unchanged():
    state, landmarks = state_with_two_walls()
    lines, covariances = state.lines.copy(), filter.line_covariances(state).copy()
    state.mean[0] = -3 * REACH
    state, landmarks, shelf = look_around(state, landmarks, empty_shelf(), UNSEEN + 1)
    assert state.size == 3
    assert len(shelf.lines) == 2
    state.mean[0] = 0.0
    state, landmarks, shelf = look_around(state, landmarks, shelf, UNSEEN + 2)
    assert len(shelf.lines) == 0
    assert np.allclose(state.lines, lines)
    assert np.allclose(filter.line_covariances(state), covariances)
    assert np.array_equal(landmarks.hits, [5, 5])


def test_lines_that_are_near_or_were_seen_just_now_stay():
    state, landmarks = state_with_two_walls()
    state, landmarks, shelf = look_around(state, landmarks, empty_shelf(), UNSEEN + 1)
    assert state.size == 7
    state.mean[0] = -3 * REACH
    state, landmarks, shelf = look_around(state, landmarks, shelf, UNSEEN - 1)
    assert state.size == 7
    assert len(shelf.lines) == 0
