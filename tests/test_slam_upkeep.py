"""Map upkeep: extents, joining, forgetting, and the map that goes out."""

import numpy as np
import pytest

from bsmap_cli.core import se2
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import filter, upkeep
from bsmap_cli.slam.segments import Segments

PARAMS = SlamParams()
SAME = np.diag([PARAMS.line_angle_floor, PARAMS.line_offset_floor]) ** 2
SIGMA = np.diag([0.003, 0.005]) ** 2


def stored(lines: list, extents: list, hits: int = 5) -> tuple[filter.FilterState, upkeep.Landmarks]:
    """A map of lines (alpha, r) with extents, seen from the origin."""
    state, landmarks = filter.initial_state(), upkeep.no_landmarks()
    for line in lines:
        state = filter.augment(state, np.array(line, float), SIGMA)
    landmarks = upkeep.append(landmarks, np.array(extents, float).reshape(-1, 2), 0)
    return state, landmarks._replace(hits=np.full(len(lines), hits))


def segments_of(lines: list, extents: list) -> Segments:
    k = len(lines)
    covariances, none = np.tile(SIGMA, (k, 1, 1)), np.zeros((k, 2))
    extents = np.array(extents, float)
    return Segments(np.zeros(k, int), np.array(lines, float), covariances, extents, np.full(k, 50), none)


def join(state: filter.FilterState, landmarks: upkeep.Landmarks, touched: list | None = None):
    touched = list(range(len(landmarks.hits))) if touched is None else touched
    return upkeep.join_lines(state, landmarks, touched, PARAMS.gate, PARAMS.overlap_margin, SAME)


def ends(pose: np.ndarray, line: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """(2, 2) end points in map of a segment seen from the pose."""
    n, t = np.array([np.cos(line[0]), np.sin(line[0])]), np.array([-np.sin(line[0]), np.cos(line[0])])
    return se2.transform(pose, n * line[1] + t * np.asarray(extent)[:, None])


@pytest.mark.parametrize("seed", range(4))
def test_extents_in_map_are_those_of_the_carried_end_points(seed):
    rng = np.random.default_rng(seed)
    pose = rng.uniform([-20, -20, -np.pi], [20, 20, np.pi])
    line, extent = rng.uniform([-np.pi, 0.5], [np.pi, 5]), np.sort(rng.uniform(-4, 4, 2))
    alpha = line[0] + pose[2]
    along = ends(pose, line, extent) @ [-np.sin(alpha), np.cos(alpha)]
    np.testing.assert_allclose(upkeep.extents_in_map(pose, line[None], extent[None])[0], along, atol=1e-12)


def test_extend_covers_what_was_seen_and_counts_each_scan_once():
    state, landmarks = stored([(0, 3), (np.pi / 2, 2)], [(-1, 1), (-1, 1)])
    seen = segments_of([(0, 3), (0, 3), (np.pi / 2, 2)], [(-2, -1.5), (0.5, 1.7), (-0.5, 0.5)])
    after = upkeep.extend(state, landmarks, seen, np.array([0, 1, 2]), np.array([0, 0, 1]), step=9)
    np.testing.assert_allclose(after.extents, [(-2, 1.7), (-1, 1)], atol=1e-12)
    assert after.hits.tolist() == [6, 6]
    assert after.last_seen.tolist() == [9, 9]
    assert landmarks.last_seen.tolist() == [0, 0]
    assert upkeep.extend(state, landmarks, seen, np.zeros(0, int), np.zeros(0, int), step=9) is landmarks


def test_extend_measures_along_the_stored_line_from_any_pose():
    state, landmarks = stored([(0.4, 12)], [(3, 4)])
    pose = np.array([5.0, 4.0, 2.0])
    state.mean[:3] = pose
    line = filter.expected_lines(pose, state.lines)[0]
    after = upkeep.extend(state, landmarks, segments_of([line], [(-2, 2)]), np.array([0]), np.array([0]), 1)
    along = ends(pose, line, (-2, 2)) @ [-np.sin(0.4), np.cos(0.4)]
    np.testing.assert_allclose(after.extents[0], [min(3, along.min()), max(4, along.max())], atol=1e-12)


def test_joining_lowers_the_count_and_keeps_all_that_was_seen():
    state, landmarks = stored([(0, 3), (1.5, 2), (0.002, 3.003)], [(-2, 0), (0, 1), (0.1, 2)])
    landmarks = landmarks._replace(last_seen=np.array([4, 5, 6]))
    state, landmarks = join(state, landmarks)
    assert len(state.lines) == len(landmarks.hits) == 2
    np.testing.assert_allclose(landmarks.extents, [(-2, 2), (0, 1)], atol=0.005)
    assert landmarks.hits.tolist() == [10, 5]
    assert landmarks.last_seen.tolist() == [6, 5]
    np.testing.assert_allclose(state.lines[0], [0.001, 3.0015], atol=0.0015)


def test_joining_many_pieces_of_one_wall_leaves_one_line():
    rng = np.random.default_rng(0)
    lines = [(np.array([0.5, 4]) + rng.normal(size=2) * [0.0005, 0.001]).tolist() for _ in range(8)]
    extents = [(k, k + 0.9) for k in rng.permutation(8)]
    _, landmarks = join(*stored([*lines, (2.0, 3)], [*extents, (0, 1)]), touched=[0])
    # Only what touches the changed line is looked at, and then what touches the joined one.
    assert len(landmarks.hits) == 2
    assert sorted(landmarks.hits.tolist()) == [5, 40]
    np.testing.assert_allclose(landmarks.extents[landmarks.hits == 40], [(0, 7.9)], atol=0.005)


@pytest.mark.parametrize(
    ("other", "extent"),
    [
        ((0.0, 3.0), (2.0, 4.0)),  # a metre away along the wall: the margin is 0.3 m
        ((0.0, 3.06), (-1.0, 1.0)),  # a step in the wall
        ((0.05, 3.0), (-1.0, 1.0)),  # a bend
        ((np.pi, -3.0), (-1.0, 1.0)),  # its other face
    ],
)
def test_what_is_not_one_line_is_not_joined(other, extent):
    _, landmarks = join(*stored([(0, 3), other], [(-1, 1), extent]))
    assert len(landmarks.hits) == 2


def test_lines_are_compared_where_they_meet_not_at_the_foot_of_the_normal():
    """Two views of a wall 40 m along from the foot: r differs by 40 times the angle, where they meet they agree."""
    turn = 0.003
    first, second = (0.0, 3.0), (turn, 3.0 + 40 * turn)
    covariance = np.array([[0.003**2, 40 * 0.003**2], [40 * 0.003**2, (40 * 0.003) ** 2 + 0.005**2]])
    state = filter.initial_state()
    for line in (first, second):
        state = filter.augment(state, np.array(line), covariance)
    landmarks = upkeep.append(upkeep.no_landmarks(), np.array([(38.0, 40.0), (40.1, 42.0)]), 0)
    _, joined = join(state, landmarks)
    assert len(joined.hits) == 1


def test_discarding_moves_the_last_line_into_the_gap_in_both_tables():
    lines = [(0.1 * k, 1.0 + k) for k in range(5)]
    for gone in range(5):
        state, landmarks = stored(lines, [(k, k + 1) for k in range(5)])
        state, landmarks = upkeep.discard(state, landmarks, gone)
        left = list(range(4)) if gone == 4 else [4 if k == gone else k for k in range(4)]
        np.testing.assert_allclose(state.lines, np.array(lines)[left], atol=1e-12)
        np.testing.assert_allclose(landmarks.extents[:, 0], left)


def test_prune_forgets_only_what_was_seen_seldom_and_long_ago():
    state, landmarks = stored([(0.1 * k, 1.0 + k) for k in range(4)], [(k, k + 1) for k in range(4)])
    landmarks = landmarks._replace(hits=np.array([1, 3, 2, 1]), last_seen=np.array([0, 0, 0, 8]))
    state, landmarks = upkeep.prune(state, landmarks, step=11, fewest_hits=3, patience=10)
    assert sorted(landmarks.extents[:, 0]) == [1, 3]
    np.testing.assert_allclose(state.lines[:, 1], 1 + landmarks.extents[:, 0])


def test_line_map_has_positive_r_and_the_same_points():
    """Where r < 0 the line turns by pi: the same points, the covariance by central differences, the other side."""
    state, landmarks = stored([(0.3, 2.0), (0.3, -2.0), (3.0, -1.0)], [(-1, 2), (-1, 2), (0, 5)])
    lines = upkeep.to_line_map(state, landmarks)
    assert np.all(lines.parameters[:, 1] >= 0)
    assert lines.sides.tolist() == [-1, 1, 1]
    turn = np.diag([1.0, -1.0])
    for k in range(3):
        before = ends(np.zeros(3), state.lines[k], landmarks.extents[k])
        after = ends(np.zeros(3), lines.parameters[k], lines.extents[k])
        np.testing.assert_allclose(np.sort(before, axis=0), np.sort(after, axis=0), atol=1e-12)
        C = filter.gather(state.covariance, np.array([3 + 2 * k, 4 + 2 * k]))
        wanted = C if lines.sides[k] < 0 else turn @ C @ turn
        np.testing.assert_allclose(lines.covariances[k], wanted, atol=1e-15)
    assert lines.extents[:, 0].tolist() == [-1, -2, -5]


def test_empty_map_is_a_line_map():
    lines = upkeep.to_line_map(filter.initial_state(), upkeep.no_landmarks())
    assert len(lines.hits) == 0


def test_extents_stay_on_the_wall_when_its_line_turns():
    """20 m from the foot's origin a correction of 0.02 rad moves the foot by 0.4 m, the wall's ends by nothing."""
    before, turn = np.array([[0.3, 20.0]]), 0.02
    wall = ends(np.zeros(3), before[0], (5.0, 9.0))
    # The line turned about the wall's middle.
    middle, after = wall.mean(axis=0), np.array([[0.3 + turn, 0.0]])
    after[0, 1] = middle @ [np.cos(after[0, 0]), np.sin(after[0, 0])]
    landmarks = upkeep.append(upkeep.no_landmarks(), np.array([(5.0, 9.0)]), 0)
    found = upkeep.follow(landmarks, before, after).extents[0]
    np.testing.assert_allclose(ends(np.zeros(3), after[0], found), wall, atol=2 * np.sin(turn) + 1e-9)
    along = np.array([-np.sin(after[0, 0]), np.cos(after[0, 0])])
    np.testing.assert_allclose(found, wall @ along, atol=1e-3)
    turned_round = upkeep.follow(landmarks, before, before + np.array([[2 * np.pi, 0.0]])).extents[0]
    np.testing.assert_allclose(turned_round, (5.0, 9.0), atol=1e-9)
