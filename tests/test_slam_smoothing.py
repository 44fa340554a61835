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
from bsmap_cli.slam.scatter import (
    FEWEST,
    LEAST_FLOOR,
    by_parts,
    by_scatter,
    centred,
    centred_errors,
    left_over,
    variance_parts,
    weighed,
)
from bsmap_cli.slam.segments import Segments
from bsmap_cli.slam.sightings import Sightings, match_all, sighting_term, with_rivals
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
    none = np.zeros((len(pose), 2))
    return Segments(pose, parameters, covariances, ends[line] - shift[:, None], np.full(len(pose), 50), none)


def sightings_of(segments: Segments, line: np.ndarray) -> Sightings:
    """Every segment paired with its line."""
    information, none = np.linalg.inv(segments.covariances), np.zeros((len(line), 2))
    return Sightings(segments.scan, line, segments.parameters, information, np.arange(len(line)), none)


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
    return Sightings(
        np.array([1]), np.array([1]), rng.normal(size=(1, 2)), information, np.array([0]), np.zeros((1, 2))
    )


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


def test_lines_out_of_sight_change_no_pair_wherever_they_stand_in_the_map():
    case, spread = Case(9), (0.05, 0.015)
    far, ends = np.repeat([[0.3, 60.0], [-2.0, 45.0]], 20, axis=0), np.tile([-1.0, 1.0], (40, 1))
    alone = match_all(case.truth, WALLS, ENDS, case.segments, GATE, MARGIN, spread)
    lines, extents = np.vstack([far, WALLS]), np.vstack([ends, ENDS])
    among = match_all(case.truth, lines, extents, case.segments, GATE, MARGIN, spread)
    np.testing.assert_array_equal(among.line, alone.line + len(far))
    np.testing.assert_array_equal(among.segment, alone.segment)


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
    line = np.arange(len(segments.scan)) % len(WALLS)
    sightings = sightings_of(segments._replace(parameters=parameters), line)
    squares = centred_errors(case.truth, WALLS, sightings, np.zeros(len(line))) ** 2
    found = by_scatter(squares, np.ones_like(squares), np.tile(SEEN**2, (len(line), 1)), line, len(WALLS))
    assert found[4] > 2.5
    assert found[:4].max() < 1.4
    assert found.min() >= 1.0


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
    none = np.zeros((m, 2))
    segments = Segments(np.zeros(m, int), lines[line] + error, covariances, extents, np.full(m, 50), none)
    return sightings_of(segments, line), segments, lines


FLOORS = np.array([0.0005, 0.001])


def scales_found(seen: Sightings, segments: Segments, lines: np.ndarray, left: float = 1.0) -> np.ndarray:
    """Of noise and floor, where errors still have the share `left` of their variances."""
    centre, told = centred(segments.covariances)
    squares = centred_errors(np.zeros((1, 3)), lines, seen, centre) ** 2
    parts = variance_parts(told, segments.angular, FLOORS)
    return by_parts(squares, np.full_like(squares, left), parts)[[0, 2]]


@pytest.mark.parametrize("scales", [(1.0, 1.0), (0.5, 4.0), (2.0, 0.2)])
def test_noise_and_floor_of_segments_are_told_apart_by_what_is_left_of_their_errors(scales):
    np.testing.assert_allclose(scales_found(*scattered(*scales)), scales, rtol=0.2, atol=0.15)


def test_noise_of_ranges_and_of_the_beams_directions_are_told_apart():
    told = centred(scattered(1.0, 0.0)[1].covariances)[1]
    noise = told - FLOORS**2
    rng = np.random.default_rng(5)
    angular = noise * rng.uniform(0.0, 1.0, size=noise.shape)
    error = np.sqrt(0.5 * (noise - angular) + 3.0 * angular) * rng.normal(size=noise.shape)
    parts = variance_parts(told, angular, FLOORS)
    np.testing.assert_allclose(by_parts(error**2, np.ones_like(noise), parts)[:2], [0.5, 3.0], rtol=0.25)


def test_errors_that_lack_what_was_fitted_to_them_still_tell_the_whole_noise():
    """Of every error a share is taken away, as a fit does on average, and what is left is told."""
    seen, segments, lines = scattered(1.0, 1.0)
    less = seen._replace(observed=lines[seen.line] + np.sqrt(0.4) * (seen.observed - lines[seen.line]))
    np.testing.assert_allclose(scales_found(less, segments, lines, 0.4), 1.0, rtol=0.25)
    np.testing.assert_allclose(scales_found(less, segments, lines), 0.4, rtol=0.25)


def test_walls_that_are_flat_keep_a_share_of_the_floor():
    assert scales_found(*scattered(1.0, 0.0))[1] >= LEAST_FLOOR


def factors_of(case: Case, seen: Sightings):
    """Of the information of poses and lines, by odometry and sightings."""
    terms = [sighting_term(case.truth, WALLS, seen), posegraph.edge_term(case.truth, case.odometry)]
    size = 3 * len(case.truth) + 2 * len(WALLS)
    N = sum(posegraph.term_matrix(term, size) for term in terms)[3:, 3:]
    return posegraph.factorise(N.tocsc()), np.linalg.inv(N.toarray())


def test_few_sightings_do_not_tell_noise_from_floor():
    case = Case(3)
    few = sightings_of(seen_from(case.truth[: FEWEST // len(WALLS) - 1], 3), np.tile(np.arange(5), 9))
    segments = seen_from(case.truth[: len(few.line) // 5], 3)
    assert len(few.line) < FEWEST
    found = weighed(case.truth, WALLS, few, segments, FLOORS, factors_of(case, few)[0])
    factor = np.diagonal(np.linalg.inv(found.information), axis1=1, axis2=2) / SEEN**2
    np.testing.assert_allclose(factor[:, 0], factor[:, 1])  # the scatter of a line, nothing of its parts
    np.testing.assert_allclose(factor[:5], factor[5:10])
    assert factor.min() == pytest.approx(1.0)


def test_share_left_over_is_that_of_least_squares():
    """Against the dense diagonal of A N^-1 A'; random signs leave an error, but no bias."""
    case = Case(3)
    seen = sightings_of(case.segments, np.arange(len(case.segments.scan)) % len(WALLS))
    factors, covariance = factors_of(case, seen)
    found = left_over(case.truth, WALLS, seen, np.zeros(len(seen.line)), factors)
    n, size = len(case.truth), 3 * len(case.truth) + 2 * len(WALLS)
    exact = np.zeros_like(found)
    for k, line in enumerate(seen.line):
        c, s = np.cos(WALLS[line, 0]), np.sin(WALLS[line, 0])
        x, y = case.truth[seen.pose[k], :2]
        A = np.zeros((2, size))
        A[:, 3 * seen.pose[k] : 3 * seen.pose[k] + 3] = [[0, 0, 1], [c, s, 0]]
        A[:, 3 * n + 2 * line : 3 * n + 2 * line + 2] = [[-1, 0], [y * c - x * s, -1]]
        leverage = np.diag(A[:, 3:] @ covariance @ A[:, 3:].T) / SEEN**2
        exact[k] = 1.0 - robust_means(2).weight * leverage
    assert found.mean(axis=0) == pytest.approx(exact.mean(axis=0), rel=0.15)
    assert np.abs(found - exact).max() < 0.75


def test_segment_that_may_belong_to_another_line_is_no_surer_than_these_are_apart():
    """Two chords of a curved wall meet: a segment across their corner may be part of either, the others not."""
    lines = np.array([[0.0, 4.0], [0.02, 4.02]])
    extents = np.array([[-1.0, 0.1], [-0.1, 1.0]])
    parameters = np.array([[0.0, 4.0], [0.01, 4.01], [0.02, 4.02]])
    covariances = np.tile(np.diag([0.01, 0.01]) ** 2, (3, 1, 1))
    spans = np.array([[-1.0, -0.5], [-0.3, 0.3], [0.5, 1.0]])
    segments = Segments(np.zeros(3, int), parameters, covariances, spans, np.full(3, 50), np.zeros((3, 2)))
    seen = sightings_of(segments, np.array([0, 0, 1]))
    found = with_rivals(np.zeros((1, 3)), lines, extents, seen, segments, GATE, 0.0)
    np.testing.assert_allclose(found.rival, [[0, 0], [0.02**2, 0.02**2], [0, 0]], atol=1e-9)
    elsewhere = with_rivals(
        np.zeros((1, 3)), lines, extents, sightings_of(segments, np.ones(3, int)), segments, GATE, 0.0
    )
    assert np.isfinite(elsewhere.rival).all()


def test_means_of_the_robust_weight_are_those_of_drawn_errors():
    rng = np.random.default_rng(0)
    for freedom in (1, 2, 3):
        distance = (rng.normal(size=(400000, freedom)) ** 2).sum(axis=1)
        weight = 1.0 / (1.0 + distance / ROBUST_WIDTH)
        means = robust_means(freedom)
        assert means[:2] == pytest.approx((weight.mean(), (weight * distance).mean()), rel=0.01)


def test_robust_mean_is_as_sure_as_its_information_with_gain_says():
    """Of 200 observations in the plane, many times over."""
    rng = np.random.default_rng(1)
    seen = rng.normal(size=(2000, 200, 2))
    mean = np.zeros((2000, 1, 2))
    for _ in range(20):
        weight = 1.0 / (1.0 + ((seen - mean) ** 2).sum(axis=2, keepdims=True) / ROBUST_WIDTH)
        mean = (weight * seen).sum(axis=1, keepdims=True) / weight.sum(axis=1, keepdims=True)
    information = weight.sum(axis=1).mean() * robust_means(2).gain
    assert mean.var() * information == pytest.approx(1.0, rel=0.05)
