"""Poses and lines smoothed together: derivatives, known answers, lines that nobody sees, false pairs."""

from dataclasses import replace

import numpy as np
import pytest
from flat_world import along
from reference import central_differences

from bsmap_cli.core import se2
from bsmap_cli.model import LineMap
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import posegraph
from bsmap_cli.slam.posegraph import ROBUST_WIDTH, Edges, robust_means
from bsmap_cli.slam.scatter import FEWEST, LEAST_FLOOR, PROBES, by_parts, by_scatter, centred, fitted_variances
from bsmap_cli.slam.segments import Segments
from bsmap_cli.slam.sightings import Sightings, match_all, sighting_term
from bsmap_cli.slam.smoothing import Evidence, smooth

WALLS = np.array([[0.0, 4.0], [np.pi / 2, 3.0], [np.pi, 4.0], [-np.pi / 2, 3.0], [0.0, 2.0]])
"""alpha, r of the sides of a room and of a board in it, as seen from within: n points away from the robot."""
ENDS = np.array([[-3.0, 3.0], [-4.0, 4.0], [-3.0, 3.0], [-4.0, 4.0], [-1.0, 1.0]])
SEEN = np.array([0.002, 0.005])
"""Standard deviations of a segment's alpha and r."""
STEP = np.array([0.02, 0.02, 0.01])
GATE, MARGIN = 0.99, 0.3


def seen_from(poses: np.ndarray, seed: int, walls: np.ndarray = WALLS, ends: np.ndarray = ENDS) -> Segments:
    """Segments of all walls at each pose, with noise."""
    rng = np.random.default_rng(seed)
    m, n = len(walls), len(poses)
    pose, line = np.repeat(np.arange(n), m), np.tile(np.arange(m), n)
    x, y, theta = poses[pose].T
    alpha, r = walls[line].T
    parameters = np.stack([se2.wrap(alpha - theta), r - x * np.cos(alpha) - y * np.sin(alpha)], axis=-1)
    parameters += SEEN * rng.normal(size=parameters.shape)
    shift = -x * np.sin(alpha) + y * np.cos(alpha)
    covariances = np.tile(np.diag(SEEN**2), (len(pose), 1, 1))
    return Segments(pose, parameters, covariances, ends[line] - shift[:, None], np.full(len(pose), 50))


def line_map(parameters: np.ndarray, ends: np.ndarray = ENDS) -> LineMap:
    m = len(parameters)
    none = np.zeros((m, 2, 2))
    return LineMap(parameters, none, ends, np.full(m, -1), np.full(m, 5))


def edges(first, second, relative, spread=STEP, robust=False) -> Edges:
    m = len(relative)
    information = np.tile(np.diag(1 / spread**2), (m, 1, 1))
    return Edges(np.asarray(first, int), np.asarray(second, int), relative, information, np.full(m, robust))


class Case:
    """A way through the room: truth, poses added up from noisy steps near it, edges, what was seen."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        way = along([(-2.0, -1.0), (1.0, -1.0), (1.0, 1.5), (-1.0, 1.5)], 0.3, 0.3)
        self.frame = way[0]
        self.truth = way
        n = len(way)
        relative = se2.between(way[:-1], way[1:]) + STEP * rng.normal(size=(n - 1, 3))
        self.odometry = edges(np.arange(n - 1), np.arange(1, n), relative)
        self.none = edges([], [], np.zeros((0, 3)), robust=True)
        self.start = way + [0.03, 0.03, 0.008] * rng.normal(size=way.shape) * (np.arange(n) > 0)[:, None]
        self.segments = seen_from(way, seed + 1000)
        self.lines = line_map(WALLS + [0.004, 0.02] * rng.normal(size=WALLS.shape))

    def smoothed(self, **changed):
        given = {"segments": self.segments, "lines": self.lines} | changed
        evidence = Evidence(self.odometry, self.none)
        return smooth(self.start, evidence, evidence, given["segments"], given["lines"], SlamParams())


def one_sighting(rng) -> Sightings:
    half = rng.normal(size=(1, 2, 2))
    information = half @ half.swapaxes(1, 2) + np.eye(2)
    return Sightings(np.array([1]), np.array([1]), rng.normal(size=(1, 2)), information, np.array([0]))


def test_derivatives_of_a_sighting_agree_with_central_differences():
    """Of the robust cost W / 2 ln(1 + d / W), whose gradient is the weight times that of d / 2; and of the error."""
    rng = np.random.default_rng(2)
    poses, lines = rng.normal(size=(2, 3)), rng.normal(size=(2, 2)) + np.array([0, 3])
    sighting = one_sighting(rng)

    def error(x):
        (px, py, theta), (alpha, r) = x[:6].reshape(2, 3)[1], x[6:].reshape(2, 2)[1]
        seen = sighting.observed[0]
        return np.array([se2.wrap(seen[0] - alpha + theta), seen[1] - r + px * np.cos(alpha) + py * np.sin(alpha)])

    def cost(x):
        distance = error(x) @ sighting.information[0] @ error(x)
        return np.array([ROBUST_WIDTH / 2 * np.log1p(distance / ROBUST_WIDTH)])

    x = np.r_[poses.ravel(), lines.ravel()]
    term = sighting_term(poses, lines, sighting)
    side = np.zeros(10)
    for rows, values in term.sides:
        side[rows[0] : rows[0] + values.shape[1]] += values[0]
    np.testing.assert_allclose(-side, central_differences(cost, x)[0], atol=1e-6)
    matrix = np.zeros((10, 10))
    for rows, columns, values in term.blocks:
        a, b = values.shape[1:]
        matrix[rows[0] : rows[0] + a, columns[0] : columns[0] + b] += values[0]
    J = central_differences(error, x)
    distance = error(x) @ sighting.information[0] @ error(x)
    weighted = J.T @ sighting.information[0] @ J / (1 + distance / ROBUST_WIDTH)
    np.testing.assert_allclose(matrix, weighted, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_poses_and_lines_are_recovered_within_what_was_seen(seed):
    case = Case(seed)
    found = case.smoothed()
    away = found.poses - case.truth
    assert np.hypot(*away[:, :2].T).max() < 0.025
    assert np.abs(se2.wrap(away[:, 2])).max() < 0.005
    # What all share hangs on the first pose alone, which nothing but itself tells.
    np.testing.assert_allclose(se2.wrap(found.lines[:, 0] - WALLS[:, 0]), 0.0, atol=0.006)
    np.testing.assert_allclose(found.lines[:, 1], WALLS[:, 1], atol=0.02)
    np.testing.assert_array_equal(found.poses[0], case.start[0])
    assert found.hits.tolist() == [len(case.truth)] * len(WALLS)
    np.testing.assert_allclose(found.extents, ENDS, atol=0.06)


def test_errors_are_as_large_as_the_information_says():
    """Normalised errors squared of all poses and lines, over seeds; the loss and the scales are estimates."""
    normalised = []
    for seed in range(20):
        case = Case(50 + seed)
        found = case.smoothed()
        error = np.concatenate([(found.poses - case.truth)[1:].ravel(), (found.lines - WALLS).ravel()])
        error[2 : 3 * len(case.truth) - 3 : 3] = se2.wrap(error[2 : 3 * len(case.truth) - 3 : 3])
        error[-2 * len(WALLS) :: 2] = se2.wrap(error[-2 * len(WALLS) :: 2])
        normalised.append(error @ (found.information @ error) / len(error))
    assert 0.7 < np.mean(normalised) < 1.3


def test_line_that_no_segment_is_matched_to_stays_where_it_is():
    case = Case(7)
    lonely, ends = np.vstack([case.lines.parameters, [0.7, 40.0]]), np.vstack([ENDS, [5.0, 6.0]])
    found = case.smoothed(lines=line_map(lonely, ends))
    np.testing.assert_array_equal(found.lines[-1], [0.7, 40.0])
    assert found.hits[-1] == 0
    np.testing.assert_allclose(found.poses, case.smoothed().poses, atol=1e-5)


def test_segment_that_is_wrong_by_more_than_the_gate_changes_nothing():
    case = Case(8)
    parameters = case.segments.parameters.copy()
    parameters[12, 1] += 0.8
    found = case.smoothed(segments=case.segments._replace(parameters=parameters))
    assert np.hypot(*(found.poses - case.truth)[:, :2].T).max() < 0.025
    assert found.hits.sum() == len(case.truth) * len(WALLS) - 1


def test_two_faces_of_a_wall_are_two_lines():
    """The board in the room is seen from in front; a line for its back, 5 cm behind, gets none of the segments."""
    case = Case(9)
    back = np.array([[np.pi, -2.05]])  # n away from a robot behind it, that is towards those in the room
    lines = np.vstack([WALLS, back])
    ends = np.vstack([ENDS, [-1.0, 1.0]])
    spread = (0.05, 0.015)
    found = match_all(case.truth, lines, ends, case.segments, GATE, MARGIN, spread)
    assert not np.any(found.line == 5)
    assert len(found.line) == len(case.segments.scan)


def test_sides_of_lines_in_the_map_are_turned_to_the_robot_and_do_not_change_the_answer():
    case = Case(10)
    lines = case.lines
    flipped = replace(
        lines,
        parameters=np.stack([se2.wrap(lines.parameters[:, 0] + np.pi), -lines.parameters[:, 1]], axis=-1),
        extents=-lines.extents[:, ::-1],
        sides=np.ones(len(WALLS), int),
    )
    np.testing.assert_allclose(case.smoothed(lines=flipped).poses, case.smoothed().poses, atol=1e-6)


def test_line_whose_sightings_scatter_counts_for_less_and_the_others_stay_as_they_are():
    """The board comes out elsewhere in every scan, as a chord of a curved wall does."""
    case, rng = Case(0), np.random.default_rng(1)
    segments = seen_from(case.truth, 0)
    board = np.flatnonzero(np.arange(len(segments.scan)) % len(WALLS) == 4)
    parameters = segments.parameters.copy()
    parameters[board, 1] += 5 * SEEN[1] * rng.normal(size=len(board))
    information = np.linalg.inv(segments.covariances)
    line = np.arange(len(segments.scan)) % len(WALLS)
    sightings = Sightings(segments.scan, line, parameters, information, np.arange(len(line)))
    found = by_scatter(case.truth, WALLS, sightings, np.zeros((len(line), 2)))
    left = found.information[:, 1, 1] / information[:, 1, 1]
    assert left[board].max() < 0.4
    assert left[line != 4].min() > 0.7
    assert left.max() <= 1.0


def scattered(noise_scale: float, floor_scale: float, seed: int = 2) -> tuple[Sightings, Segments, np.ndarray]:
    """Sightings from the origin, 30 of each of 20 lines, whose errors have noise and floor of these scales of variance.

    Their segments are long or short, so that the floor or the noise prevails, and are told both with scale 1.
    """
    rng, floors = np.random.default_rng(seed), np.array([0.0005, 0.001])
    line = np.tile(np.arange(20), 30)
    m = len(line)
    lines = np.stack([np.linspace(-3.0, 3.0, 20), np.full(20, 4.0)], axis=1)
    noise = np.where(rng.uniform(size=m) < 0.5, 1.0, 0.1)[:, None] * [0.003, 0.005]
    centre = rng.uniform(-5.0, 5.0, m)
    told = noise**2 + floors**2
    error = np.sqrt(noise_scale * noise**2 + floor_scale * floors**2) * rng.normal(size=(m, 2))
    error[:, 1] += centre * error[:, 0]
    covariances = np.stack(
        [told[:, 0], centre * told[:, 0], centre * told[:, 0], told[:, 1] + centre**2 * told[:, 0]], 1
    )
    covariances = covariances.reshape(-1, 2, 2)
    extents = np.stack([centre - 1.0, centre + 1.0], axis=1)
    segments = Segments(np.zeros(m, int), lines[line] + error, covariances, extents, np.full(m, 50))
    seen = Sightings(segments.scan, line, segments.parameters, np.linalg.inv(covariances), np.arange(m))
    return seen, segments, lines


FLOORS = np.array([0.0005, 0.001])


def parts_of(seen: Sightings, segments: Segments, lines: np.ndarray, fitted: np.ndarray) -> Sightings:
    return by_parts(np.zeros((1, 3)), lines, seen, segments.covariances[: len(seen.line)], FLOORS, fitted)


def scales_found(found: Sightings, segments: Segments) -> np.ndarray:
    """Of noise and floor in the variances of direction."""
    alpha, told = np.linalg.inv(found.information)[:, 0, 0], segments.covariances[:, 0, 0]
    parts = np.stack([told - FLOORS[0] ** 2, np.full(len(told), FLOORS[0] ** 2)], axis=1)
    return np.linalg.lstsq(parts, alpha, rcond=None)[0]


@pytest.mark.parametrize("scales", [(1.0, 1.0), (0.5, 4.0), (2.0, 0.2)])
def test_noise_and_floor_of_segments_are_told_apart_by_what_is_left_of_their_errors(scales):
    seen, segments, lines = scattered(*scales)
    found = parts_of(seen, segments, lines, np.zeros((len(seen.line), 2)))
    centre, alpha = segments.extents.mean(axis=1), np.linalg.inv(found.information)
    np.testing.assert_allclose(alpha[:, 0, 1], centre * alpha[:, 0, 0], rtol=1e-9)
    np.testing.assert_allclose(scales_found(found, segments), scales, rtol=0.2, atol=0.15)


def test_errors_that_lack_what_was_fitted_to_them_still_tell_the_whole_noise():
    """Of every error a share is taken away, as a fit does on average, and the variance of that share is told."""
    seen, segments, lines = scattered(1.0, 1.0)
    left = seen._replace(observed=lines[seen.line] + np.sqrt(0.4) * (seen.observed - lines[seen.line]))
    fitted = 0.6 * centred(segments.covariances)[1]
    np.testing.assert_allclose(scales_found(parts_of(left, segments, lines, fitted), segments), 1.0, rtol=0.25)
    np.testing.assert_allclose(scales_found(parts_of(left, segments, lines, 0.0 * fitted), segments), 0.4, rtol=0.25)


def test_walls_that_are_flat_keep_a_share_of_the_floor():
    seen, segments, lines = scattered(1.0, 0.0)
    found = np.linalg.inv(parts_of(seen, segments, lines, np.zeros((len(seen.line), 2))).information)
    assert found[:, 0, 0].min() > LEAST_FLOOR * FLOORS[0] ** 2


def test_few_sightings_do_not_tell_noise_from_floor():
    seen, segments, lines = scattered(1.0, 4.0)
    few = Sightings(*(column[: FEWEST - 1] for column in seen))
    assert parts_of(few, segments, lines, np.zeros((len(few.line), 2))) is few


def test_fitted_variances_are_those_of_what_poses_and_lines_predict():
    """Against the dense diagonal of A N^-1 A', by central differences; random signs leave an error, but no bias."""
    case = Case(3)
    segments, poses = case.segments, case.truth
    line = np.arange(len(segments.scan)) % len(WALLS)
    seen = Sightings(
        segments.scan, line, segments.parameters, np.linalg.inv(segments.covariances), np.arange(len(line))
    )
    terms = [sighting_term(poses, WALLS, seen), posegraph.edge_term(poses, case.odometry)]
    n, size = len(poses), 3 * len(poses) + 2 * len(WALLS)
    N = sum(posegraph.term_matrix(term, size) for term in terms)[3:, 3:]
    covariance = np.linalg.inv(N.toarray())
    found = fitted_variances(poses, WALLS, seen, segments.covariances, posegraph.factorise(N.tocsc()))
    exact = np.zeros_like(found)
    for k in range(len(line)):
        c, s = np.cos(WALLS[line[k], 0]), np.sin(WALLS[line[k], 0])
        x, y = poses[segments.scan[k], :2]
        A = np.zeros((2, size))
        A[:, 3 * segments.scan[k] : 3 * segments.scan[k] + 3] = [[0, 0, 1], [c, s, 0]]
        A[:, 3 * n + 2 * line[k] : 3 * n + 2 * line[k] + 2] = [[-1, 0], [y * c - x * s, -1]]
        exact[k] = np.diag(A[:, 3:] @ covariance @ A[:, 3:].T)  # the covariances are diagonal: centred at 0
    assert found.mean(axis=0) == pytest.approx(exact.mean(axis=0), rel=0.15)
    assert np.abs(found - exact).max() < 3 * np.max(SEEN**2) / np.sqrt(PROBES) * 2


def test_means_of_the_robust_weight_are_those_of_drawn_errors():
    rng = np.random.default_rng(0)
    for freedom in (1, 2, 3):
        distance = (rng.normal(size=(400000, freedom)) ** 2).sum(axis=1)
        weight = 1.0 / (1.0 + distance / ROBUST_WIDTH)
        expected = float(weight.mean()), float((weight * distance).mean())
        assert robust_means(freedom) == pytest.approx(expected, rel=0.01)
