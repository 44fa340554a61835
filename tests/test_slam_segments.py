"""Line segments from scans: corners, breaks, fit against the paper's double sums, calibrated covariance."""

from dataclasses import replace

import numpy as np
import pytest
from reference import polar_line_fit
from scipy.stats import chi2

from bsmap_cli.core import se2
from bsmap_cli.params import SlamParams
from bsmap_cli.slam.segments import ScanPoints, Segments, extract_segments, scan_points

SIGMA = 0.01
AT_BASE = np.zeros(3)
FULL = np.linspace(-np.pi, np.pi, 720, endpoint=False)
HALF = np.linspace(-np.pi / 2, np.pi / 2, 361)
DEFAULT = SlamParams()
BARE = SlamParams(line_angle_floor=0.0, line_offset_floor=0.0, split_distance=0.2)
SQUARE = [((-3, -2), (4, -2)), ((4, -2), (4, 3)), ((4, 3), (-3, 3)), ((-3, 3), (-3, -2))]


def cast(angles: np.ndarray, walls: list, origin: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """Ranges (m,) to walls ((x0, y0), (x1, y1)) from the origin; nan where nothing is hit."""
    d = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    best = np.full(len(angles), np.inf)
    for a, b in walls:
        a, e = np.subtract(a, origin), np.subtract(b, a)
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = d[:, 0] * e[1] - d[:, 1] * e[0]
            t = (a[0] * e[1] - a[1] * e[0]) / cross
            s = (a[0] * d[:, 1] - a[1] * d[:, 0]) / cross
        best = np.where((t > 0) & (s >= -1e-9) & (s <= 1 + 1e-9) & (t < best), t, best)
    return np.where(np.isfinite(best), best, np.nan)


def noisy(ranges: np.ndarray, seed: int = 0, sigma: float = SIGMA) -> np.ndarray:
    return ranges + sigma * np.random.default_rng(seed).normal(size=ranges.shape)


def points_of(ranges: np.ndarray, angles: np.ndarray, mount: np.ndarray = AT_BASE) -> ScanPoints:
    ranges = np.atleast_2d(ranges)
    return scan_points(ranges, angles, mount, np.zeros((len(ranges), 3)))


def extract(
    ranges: np.ndarray, angles: np.ndarray, params: SlamParams = DEFAULT, mount: np.ndarray = AT_BASE
) -> Segments:
    return extract_segments(points_of(ranges, angles, mount), mount[:2], SIGMA, params)


def ends(segments: Segments) -> np.ndarray:
    """(k, 2, 2) end points, by ascending t."""
    alpha, r = segments.parameters.T
    n, t = np.stack([np.cos(alpha), np.sin(alpha)], -1), np.stack([-np.sin(alpha), np.cos(alpha)], -1)
    return (n * r[:, None])[:, None] + t[:, None] * segments.extents[..., None]


def assert_lines(segments: Segments, wanted: list[tuple[float, float]], angle: float = 0.01, offset: float = 0.02):
    """The segments are these lines (alpha, r), in any order."""
    assert len(segments.scan) == len(wanted)
    for alpha, r in wanted:
        turn = np.abs(se2.wrap(segments.parameters[:, 0] - alpha))
        assert np.any((turn < angle) & (np.abs(segments.parameters[:, 1] - r) < offset)), (alpha, r)


def test_room_gives_its_walls_with_ends_at_the_corners():
    segments = extract(noisy(cast(FULL, SQUARE)), FULL)
    # The wall behind is cut where the scan begins and ends.
    assert_lines(segments, [(-np.pi / 2, 2), (0, 4), (np.pi / 2, 3), (np.pi, 3), (np.pi, 3)])
    corners = np.array([(4, -2), (4, 3), (-3, 3), (-3, -2)])
    found = ends(segments).reshape(-1, 2)
    nearest = np.linalg.norm(found[:, None] - corners, axis=2).min(axis=1)
    assert np.sort(nearest)[:8].max() < 0.15


def test_closed_ring_of_exact_ranges_is_split():
    """First and last beam in one direction: the chord from end to end has no length."""
    angles = np.linspace(-np.pi, np.pi, 721)
    ranges = cast(angles, SQUARE)
    ranges[-1] = ranges[0]
    closed = points_of(ranges, angles)
    closed = closed._replace(xy=np.r_[closed.xy[:-1], closed.xy[:1]])
    segments = extract_segments(closed, np.zeros(2), SIGMA, SlamParams())
    assert_lines(segments, [(-np.pi / 2, 2), (0, 4), (np.pi / 2, 3), (np.pi, 3), (np.pi, 3)])


@pytest.mark.parametrize("corner", [15, 30, 60, 90, 120, 150])
@pytest.mark.parametrize("inward", [-1, 1])
def test_corner_is_found_at_its_place(corner, inward):
    """Two walls of 2 m that meet 3 m ahead, turned by `corner` degrees away from a straight wall."""
    bend = np.radians(corner / 2)
    left = (3 + inward * 2 * np.sin(bend), 2 * np.cos(bend))
    right = (3 + inward * 2 * np.sin(bend), -2 * np.cos(bend))
    segments = extract(noisy(cast(HALF, [(right, (3, 0)), ((3, 0), left)])), HALF)
    assert len(segments.scan) == 2
    touching = np.linalg.norm(ends(segments) - [3, 0], axis=2).min(axis=1)
    assert touching.max() < 0.15
    turned = abs(se2.wrap(segments.parameters[0, 0] - segments.parameters[1, 0]))
    assert turned == pytest.approx(np.radians(corner), abs=0.03)


def test_straight_wall_stays_one_segment_at_any_distance_and_angle():
    for distance in (0.5, 2.0, 8.0):
        for slope in (0.0, 0.5, -0.8):
            far = 1.5 * distance
            wall = ((distance + slope * far, -far), (distance - slope * far, far))
            segments = extract(noisy(cast(HALF, [wall])), HALF)
            assert len(segments.scan) == 1, (distance, slope)


def test_noise_of_the_papers_size_does_not_split_walls():
    """0.03 m: the farthest of many points is farther off than the split distance."""
    ranges = np.stack([noisy(cast(HALF, [((2, -2), (2, 2))]), seed, 0.03) for seed in range(50)])
    segments = extract_segments(points_of(ranges, HALF), np.zeros(2), 0.03, SlamParams())
    assert len(segments.scan) < 55


def test_wall_before_a_wall_makes_a_break():
    walls = [((2, -0.5), (2, 0.5)), ((2.4, -3), (2.4, 3))]
    segments = extract(noisy(cast(HALF, walls)), HALF)
    assert_lines(segments, [(0, 2), (0, 2.4), (0, 2.4)])


def test_beams_without_return_are_bridged_up_to_a_limit():
    ranges = noisy(cast(HALF, [((2, -2), (2, 2))]))
    for missing, count in ((5, 1), (6, 2)):
        holed = ranges.copy()
        holed[180 : 180 + missing] = np.nan
        assert len(extract(holed, HALF).scan) == count


def test_few_points_and_short_pieces_make_no_segment():
    params = SlamParams()
    ranges = np.full(361, np.nan)
    few = ranges.copy()
    few[:: 361 // params.min_points] = 2.0  # far apart
    assert len(extract(few, HALF).scan) == 0
    step = HALF[1] - HALF[0]
    angles = np.arange(20) * step
    for count in (params.min_points - 1, params.min_points):
        near = np.full(20, np.nan)
        near[:count] = 20.0 / np.cos(angles[:count])
        assert len(extract(near, angles).scan) == (count >= params.min_points)
    # Many points on 0.2 m.
    assert len(extract(noisy(cast(HALF, [((0.5, -0.1), (0.5, 0.1))])), HALF).scan) == 0


def test_clutter_is_no_wall():
    """Points spread by half a metre have no line in them that the noise could explain."""
    rng = np.random.default_rng(0)
    segments = extract(2 + 0.25 * rng.normal(size=(50, 361)), HALF)
    assert len(segments.scan) < 5


@pytest.mark.parametrize("ranges", [np.zeros((0, 361)), np.full((3, 361), np.nan)])
def test_no_returns_no_segments(ranges):
    segments = extract(ranges, HALF)
    assert [np.shape(field) for field in segments] == [(0,), (0, 2), (0, 2, 2), (0, 2), (0,), (0, 2)]


def test_scans_do_not_mix_and_are_found_by_number():
    scan = cast(HALF, [((2, -2), (2, 2))])
    ranges = np.stack([noisy(scan, 1), np.full(361, np.nan), noisy(scan, 2)])
    together = extract(ranges, HALF)
    assert together.scan.tolist() == [0, 2]
    assert len(together.of_scan(1).scan) == 0
    alone = extract(ranges[2], HALF)
    for one, other in zip(together.of_scan(2)[1:], alone[1:], strict=True):
        np.testing.assert_array_equal(one, other)


def test_normal_points_away_from_the_laser_wherever_base_link_is():
    """A laser 1 m ahead of base_link sees a wall between them from the front: r is negative."""
    angles = np.linspace(np.pi / 2, 3 * np.pi / 2, 361)
    mount = np.array([1.0, 0.0, 0.0])
    behind = extract(cast(angles, [((-0.6, -2), (-0.6, 2))]), angles, mount=mount)  # at x = 0.4 in base_link
    assert_lines(behind, [(np.pi, -0.4)])
    ahead = extract(cast(HALF, [((2, -2), (2, 2))]), HALF, mount=mount)
    assert_lines(ahead, [(0.0, 3.0)])


def test_mount_and_motion_place_the_points():
    """Each beam of a turning and moving robot is set back to where it was at the first beam."""
    mount, twist = np.array([0.2, -0.1, 0.3]), np.array([1e-4, -2e-5, 5e-5])
    rng = np.random.default_rng(0)
    world = rng.uniform(1, 5, (361, 2))
    robot = np.arange(361)[:, None] * twist
    lasers = se2.compose(robot, np.tile(mount, (361, 1)))
    seen = se2.between(lasers, np.c_[world, np.zeros(361)])[:, :2]
    # One beam a direction: the angles are those under which the points are seen.
    points = scan_points(np.hypot(*seen.T)[None], np.arctan2(seen[:, 1], seen[:, 0]), mount, twist[None])
    np.testing.assert_allclose(points.xy, world, atol=1e-9)
    np.testing.assert_allclose(points.direction, (world - lasers[:, :2]) / points.range[:, None], atol=1e-9)


@pytest.mark.parametrize("seed", range(6))
def test_fit_is_the_papers_double_sum(seed):
    """Eq. (3), with the weights that the fit arrives at."""
    rng = np.random.default_rng(seed)
    heading = rng.uniform(-np.pi, np.pi)
    angles = heading + np.linspace(-0.6, 0.6, 60)
    ranges = noisy(rng.uniform(1, 5) / np.cos(angles - heading - rng.uniform(-0.3, 0.3)), seed)
    segments = extract(ranges, angles)
    assert segments.points.tolist() == [60]
    alpha = polar_line_fit(ranges, angles, np.ones(60))[0]
    along, across = np.cos(angles - alpha), np.sin(angles - alpha)
    params = SlamParams()
    weights = 1 / ((SIGMA * along) ** 2 + (params.angle_sigma * ranges * across) ** 2 + (0.1 * SIGMA) ** 2)
    alpha, r = polar_line_fit(ranges, angles, weights)
    np.testing.assert_allclose(se2.wrap(segments.parameters[0] - [alpha, r]), 0.0, atol=1e-9)


@pytest.mark.parametrize(("distance", "slope", "shift"), [(2.0, 0.0, 0.0), (4.0, 0.6, 1.0), (1.0, -0.9, -0.5)])
def test_line_covariance_is_calibrated(distance, slope, shift):
    """Normalised squared errors of many fits have their chi-square mean; each parameter its standard deviation."""
    trials, laser = 1500, np.array([shift, 0.2, 0.0])
    wall = ((distance + 2 * slope, -2.0), (distance - 2 * slope, 2.0))
    exact = cast(HALF, [wall], origin=tuple(laser[:2]))
    rng = np.random.default_rng(7)
    directions = HALF + BARE.angle_sigma * rng.normal(size=(trials, 361))
    seen = np.stack([cast(d, [wall], origin=tuple(laser[:2])) for d in directions])
    seen[:, ~np.isfinite(exact)] = np.nan
    segments = extract(seen + SIGMA * rng.normal(size=seen.shape), HALF, BARE, laser)
    assert len(segments.scan) == trials
    alpha = np.arctan(slope)
    truth = [alpha, distance * np.cos(alpha)]
    error = segments.parameters - truth
    error[:, 0] = se2.wrap(error[:, 0])
    nees = np.einsum("ki,ki->k", error, np.linalg.solve(segments.covariances, error[..., None])[..., 0])
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 2 * trials) / trials
    # The covariance widens with the residuals and never narrows: up to a tenth too careful.
    assert 0.85 * low < nees.mean() < high
    for k in (0, 1):
        told = np.sqrt(segments.covariances[:, k, k].mean())
        assert error[:, k].std() == pytest.approx(told, rel=0.12)


def test_rough_wall_gets_a_wider_covariance():
    wall = cast(HALF, [((2, -2), (2, 2))])
    smooth, rough = extract(noisy(wall, sigma=SIGMA), HALF, BARE), extract(noisy(wall, sigma=2 * SIGMA), HALF, BARE)
    assert len(smooth.scan) == len(rough.scan) == 1
    ratio = rough.covariances[0, 0, 0] / smooth.covariances[0, 0, 0]
    assert 2.5 < ratio < 5.0


def test_floor_widens_about_the_segment_not_about_the_origin():
    """A floor of the angle turns a segment about its middle: there the offset's variance is the floor's."""
    params = SlamParams(line_angle_floor=0.1, line_offset_floor=0.0)
    segments = extract(noisy(cast(HALF, [((2, 3), (2, 5))])), HALF, params)
    middle = segments.extents.mean(axis=1)
    J = np.array([-middle[0], 1.0])  # change of a point's offset with alpha and r
    assert np.sqrt(J @ segments.covariances[0] @ J) < 0.01
    assert np.sqrt(segments.covariances[0, 0, 0]) == pytest.approx(0.1, rel=0.05)


def test_angular_variances_are_what_the_noise_of_the_beams_directions_adds():
    """Scans of a wall with noise in the directions alone, of a laser that has both."""
    params, rng, trials = replace(BARE, angle_sigma=0.004), np.random.default_rng(3), 1000
    wall = ((6.0, -2.0), (2.0, 2.0))
    directions = HALF + params.angle_sigma * rng.normal(size=(trials, len(HALF)))
    seen = np.stack([cast(d, [wall]) for d in directions])
    seen[:, ~np.isfinite(cast(HALF, [wall]))] = np.nan
    segments = extract(seen, HALF, params)
    assert len(segments.scan) == trials
    alpha, r = segments.parameters.T
    centre = segments.covariances[:, 0, 1] / segments.covariances[:, 0, 0]
    told = segments.angular.mean(axis=0)
    assert alpha.var() == pytest.approx(told[0], rel=0.15)
    assert (r - centre.mean() * alpha).var() == pytest.approx(told[1], rel=0.15)
