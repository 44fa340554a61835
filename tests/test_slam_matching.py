"""Matching of oriented points: displacements, what cannot be told, thin walls, the search, the information's truth."""

import numpy as np
import pytest
from flat_world import SIGMA, box, log_of, ring, room, wall_points
from scipy.stats import chi2

from bsmap_cli.core import se2
from bsmap_cli.slam.matching import OrientedPoints, make_target, match, oriented_points, search
from bsmap_cli.slam.segments import scan_points

LOOSE = 1e-6 * np.eye(3)
ORIGIN = (0.0, 0.0)


def seen_at(pose: np.ndarray, points: OrientedPoints, seed: int = 0, sigma: float = SIGMA) -> OrientedPoints:
    """Points of the map as a laser at `pose` has them in its frame, with noise across the wall."""
    noise = sigma * np.random.default_rng(seed).normal(size=(len(points.xy), 1))
    back = se2.between(pose, np.zeros(3))
    return OrientedPoints(points.xy + noise * points.normal, points.normal).moved(back)


@pytest.fixture(scope="module")
def target():
    return make_target(wall_points(room(), ORIGIN))


@pytest.fixture(scope="module")
def points():
    return wall_points(room(), ORIGIN, spacing=0.11)


@pytest.mark.parametrize("pose", [(0, 0, 0), (0.2, -0.15, 0.05), (-0.3, 0.25, -0.1), (0.05, 0.3, 0.15)])
def test_known_displacement_is_found_within_the_noise(target, points, pose):
    pose = np.array(pose, float)
    found = match(seen_at(pose, points), target, np.zeros(3), LOOSE, SIGMA)
    error = se2.between(pose, found.pose)
    assert np.hypot(*error[:2]) < 0.004
    assert abs(error[2]) < 0.001
    assert found.inliers > 0.95
    assert found.rms < 2 * SIGMA


def test_match_from_the_answer_stays_there(target, points):
    pose = np.array([0.7, -0.4, 0.3])
    found = match(seen_at(pose, points, sigma=0.0), target, pose, LOOSE, SIGMA)
    np.testing.assert_allclose(found.pose, pose, atol=1e-6)


def test_information_is_that_of_the_scatter(target, points):
    """Over seeds the errors' squared distances have the mean of chi-square; a little less, for the loss is robust."""
    pose, distances = np.array([0.05, -0.03, 0.02]), []
    for seed in range(60):
        found = match(seen_at(pose, points, seed), target, np.zeros(3), LOOSE, SIGMA)
        error = found.pose - pose
        distances.append(error @ found.information @ error)
    low, high = chi2.ppf([0.001, 0.999], 3 * len(distances))
    assert 0.9 * low < sum(distances) < high


def test_where_only_the_prior_pulls_the_match_is_its_normal_equations(target, points):
    """One step from a start that the points agree with, against numpy: prior and points weighed by information."""
    prior = np.array([[4e4, 1e3, -2e3], [1e3, 3e4, 5e2], [-2e3, 5e2, 6e4]])
    pose = np.array([0.004, -0.003, 0.001])
    found = match(seen_at(pose, points, sigma=0.0), target, np.zeros(3), prior, SIGMA, reach=0.15)
    between = np.linalg.solve(found.information + prior, found.information @ pose)
    np.testing.assert_allclose(found.pose, between, atol=2e-5)


def test_bare_corridor_keeps_the_prior_along_it():
    walls = np.array([[[-8, -1], [8, -1]], [[-8, 1], [8, 1]]], float)
    inside = wall_points(walls / [2.0, 1.0], ORIGIN, spacing=0.07)
    start = np.array([0.4, 0.05, 0.02])
    found = match(
        seen_at(np.array([0.1, -0.1, 0.0]), inside), make_target(wall_points(walls, ORIGIN)), start, LOOSE, SIGMA
    )
    assert found.pose[0] == pytest.approx(0.4, abs=0.01)
    np.testing.assert_allclose(found.pose[1:], [-0.1, 0.0], atol=0.003)
    weakest = np.linalg.eigvalsh(found.information)[0]
    assert weakest < 1e-6 * found.information[1, 1]


@pytest.mark.parametrize("turn", [0.0, 0.3, np.pi / 2])
def test_single_wall_without_any_prior_moves_nothing_along_it(turn):
    wall = wall_points(np.array([[[-3, 2], [3, 2]]], float), ORIGIN).moved(np.array([0.0, 0.0, turn]))
    found = match(wall, make_target(wall), np.zeros(3), np.zeros((3, 3)), SIGMA)
    np.testing.assert_allclose(found.pose, 0.0, atol=1e-6)


def test_prior_holds_against_nothing_and_gives_way_to_many_points(target, points):
    prior = np.diag([1 / 0.05**2, 1 / 0.05**2, 1 / 0.02**2])
    pose = np.array([0.1, 0.0, 0.0])
    found = match(seen_at(pose, points), target, np.zeros(3), prior, SIGMA)
    np.testing.assert_allclose(found.pose, pose, atol=0.004)
    few = OrientedPoints(points.xy[:3], points.normal[:3])
    nothing = match(few, target, np.array([0.1, 0.2, 0.3]), prior, SIGMA)
    np.testing.assert_array_equal(nothing.pose, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(nothing.information, 0.0)
    assert nothing.inliers == 0.0


def test_opposite_faces_of_a_thin_wall_never_pair():
    wall = np.array([[[-3, 0], [3, 0]]], float)
    front, back = wall_points(wall, (0, -1)), wall_points(wall + np.array([0, 0.05]), (0, 1))
    found = match(back, make_target(front), np.zeros(3), LOOSE, SIGMA)
    assert found.inliers == 0.0
    np.testing.assert_array_equal(found.pose, 0.0)
    corner = wall_points(np.array([[[3, 0], [3, 4]]], float), ORIGIN)
    both = OrientedPoints(np.r_[back.xy, corner.xy], np.r_[back.normal, corner.normal])
    seen = OrientedPoints(np.r_[front.xy, corner.xy], np.r_[front.normal, corner.normal])
    found = match(both, make_target(seen), np.zeros(3), np.diag([1e-6, 1.0, 1e4]), SIGMA)
    assert abs(found.pose[1]) < 1e-3, "the other face, 5 cm off, would have pulled"


def test_search_finds_a_start_that_is_too_far_for_the_match(target, points):
    pose = np.array([1.1, -0.8, 0.45])
    seen = seen_at(pose, points)
    assert match(seen, target, np.zeros(3), LOOSE, SIGMA).inliers < 0.7
    starts = search(seen, target, np.zeros(3), 1.5, 0.6)
    found = max((match(seen, target, start, LOOSE, SIGMA) for start in starts), key=lambda m: m.inliers)
    np.testing.assert_allclose(found.pose, pose, atol=0.005)
    assert found.inliers > 0.95


def test_search_begins_where_the_points_themselves_would_choose_to(target, points):
    """Slow twin: every point of every start asks for its own nearest one, not for that of a cell."""
    seen = seen_at(np.array([0.7, -0.5, 0.2]), points)
    thin = OrientedPoints(*(part[:: len(points.xy) // 70] for part in seen))
    steps, angles = 0.3 * np.arange(-3, 4), 0.12 * np.arange(-3, 4)
    score = {}
    for start in np.array(np.meshgrid(steps, steps, angles)).reshape(3, -1).T:
        placed = thin.moved(start)
        away, nearest = target.tree.query(placed.xy)
        facing = np.einsum("ij,ij->i", target.points.normal[nearest], placed.normal) > 0.7
        score[tuple(np.round(start, 6))] = float(np.mean(np.exp(-0.5 * (away / 0.24) ** 2) * facing * (away < 0.72)))
    found = search(seen, target, np.zeros(3), 1.0, 0.4)[0]
    assert score[tuple(np.round(found, 6))] > 0.95 * max(score.values())


def test_search_prefers_the_nearest_of_equal_places():
    """Boxes alike in a row: nothing but the distance tells which one it is."""
    boxes = np.concatenate([box(x, 2, x + 0.5, 2.5) for x in (-2.4, 0.0, 2.4)])
    seen = wall_points(box(0, 2, 0.5, 2.5), ORIGIN)
    start = search(seen, make_target(wall_points(boxes, ORIGIN)), np.zeros(3), 3.0, 0.0)[0]
    np.testing.assert_array_equal(start, 0.0)


def test_search_without_points_stays_where_it_is(target):
    nothing = OrientedPoints(np.zeros((0, 2)), np.zeros((0, 2)))
    assert [s.tolist() for s in search(nothing, target, np.array([1.0, 2, 3]), 1.0, 1.0)] == [[1.0, 2.0, 3.0]]


def test_normals_are_those_of_the_walls_and_point_to_the_laser():
    log = log_of(ring(), np.array([[6.5, -1.0, 0.4]]), sigma=0.003)
    scan = scan_points(log.horizontal.ranges, log.horizontal.angles, np.zeros(3), np.zeros((1, 3)))
    found, index = oriented_points(scan, np.zeros(2), 0.003)
    assert len(index) > 250
    np.testing.assert_array_equal(found.xy, scan.xy[index])
    assert np.all(np.einsum("ij,ij->i", found.normal, found.xy) < 0)
    in_map = found.moved(np.array([6.5, -1.0, 0.4])).normal
    axis = np.abs(in_map).max(axis=1)  # every wall is along x or y
    assert np.quantile(np.arccos(np.minimum(axis, 1)), 0.9) < 0.15
