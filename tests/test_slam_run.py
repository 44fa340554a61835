"""SLAM from end to end on simulated logs: accuracy, consistency, and logs that lack what one expects."""

from dataclasses import fields, replace

import numpy as np
import pytest
from scenes import simulated, true_slam_map
from scipy.stats import chi2

from bsmap_cli.core import se2
from bsmap_cli.errors import BadInputError
from bsmap_cli.evaluate import align, distance_to_mesh, transform_points
from bsmap_cli.model import ScanLog, SlamMap
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import run_slam

PARAMS = SlamParams()
PAPER = SlamParams(method="paper")
BOTH = pytest.mark.parametrize("params", [PARAMS, PAPER], ids=["graph", "paper"])


def part(log: ScanLog, rows: slice | np.ndarray) -> ScanLog:
    """The log of some horizontal scans, without the vertical laser."""
    scans = replace(log.horizontal, time_ns=log.horizontal.time_ns[rows], ranges=log.horizontal.ranges[rows])
    return ScanLog(scans, None if log.odometry is None else log.odometry[rows], None)


def with_ranges(log: ScanLog, ranges: np.ndarray) -> ScanLog:
    return replace(log, horizontal=replace(log.horizontal, ranges=ranges))


def covariances_are_sound(slam: SlamMap) -> bool:
    P = np.concatenate([slam.trajectory.covariances[:, :2, :2].reshape(-1, 4), slam.lines.covariances.reshape(-1, 4)])
    P = P.reshape(-1, 2, 2)
    full = slam.trajectory.covariances
    return bool(
        np.all(np.isfinite(full))
        and np.array_equal(P, P.swapaxes(1, 2))
        and np.all(np.linalg.eigvalsh(P) > -1e-15)
        and np.all(np.linalg.eigvalsh(full) > -1e-12)
    )


@pytest.fixture(scope="module")
def room() -> ScanLog:
    return simulated("room").log


@pytest.fixture(scope="module")
def corridor() -> ScanLog:
    return simulated("corridor").log


@BOTH
def test_room_is_tracked_within_two_millimetres(room, params):
    slam = run_slam(room, params)
    assert align(slam.trajectory, simulated("room").truth).rms < 0.002
    assert covariances_are_sound(slam)
    assert len(slam.lines.hits) < 30
    assert slam.vertical is room.vertical


@BOTH
def test_corridor_in_motion_is_tracked_and_the_map_stays_small(corridor, params):
    slam = run_slam(part(corridor, slice(0, 250)), params)
    assert align(slam.trajectory, simulated("corridor").truth).rms < 0.01
    assert covariances_are_sound(slam)
    assert len(slam.lines.hits) < 100
    assert slam.statistics.stored.max() < 150


@BOTH
def test_segments_of_the_map_end_where_the_walls_do(corridor, params):
    """Both ends of what was seen often lie on the scene, though the lines were turned since they were first seen."""
    simulation = simulated("corridor")
    lines = run_slam(part(corridor, slice(0, 400)), params).lines
    (alpha, r), often = lines.parameters.T, lines.hits > 10
    n, t = np.stack([np.cos(alpha), np.sin(alpha)], -1), np.stack([-np.sin(alpha), np.cos(alpha)], -1)
    ends = (n * r[:, None])[:, None] + t[:, None] * lines.extents[..., None]
    first = simulation.truth.poses[np.searchsorted(simulation.truth.time_ns, corridor.horizontal.time_ns[0])]
    height = np.full((2 * np.count_nonzero(often), 1), 0.35)
    points = transform_points(first, np.c_[ends[often].reshape(-1, 2), height])
    assert distance_to_mesh(points, simulation.vertices, simulation.triangles).max() < 0.12


@BOTH
def test_corridor_without_odometry_at_ten_hertz(corridor, params):
    """Constant velocity as prior; the robot starts from standing, which nothing but the scans can tell."""
    log = replace(part(corridor, slice(0, 300)), odometry=None)
    slam = run_slam(log, params)
    truth = true_slam_map(simulated("corridor")).trajectory.poses[:300]
    assert np.hypot(*truth[-1, :2]) > 10
    assert np.hypot(*(slam.trajectory.poses - truth)[:, :2].T).max() < 0.15


def test_innovations_and_pose_errors_are_consistent(corridor):
    """The filter may be careful (a wall is never as flat as simulated), but not sure of what is wrong."""
    slam = run_slam(part(corridor, slice(0, 300)), PAPER)
    dof = slam.statistics.dof.sum()
    assert dof > 500
    assert 0.2 < slam.statistics.nis.sum() / dof < chi2.ppf(0.999, dof) / dof
    truth = true_slam_map(simulated("corridor")).trajectory.poses[:300]
    error = slam.trajectory.poses - truth
    error[:, 2] = se2.wrap(error[:, 2])
    nees = np.einsum(
        "ki,ki->k", error[50:], np.linalg.solve(slam.trajectory.covariances[50:], error[50:, :, None])[..., 0]
    )
    assert np.median(nees) < chi2.ppf(0.99, 3)


@BOTH
def test_same_log_same_map(room, params):
    one, other = run_slam(part(room, slice(0, 40)), params), run_slam(part(room, slice(0, 40)), params)
    for table in ("trajectory", "lines", "statistics"):
        for field in fields(getattr(one, table)):
            np.testing.assert_array_equal(*(getattr(getattr(slam, table), field.name) for slam in (one, other)))


@BOTH
def test_map_frame_is_the_first_pose_whatever_the_odometry_says(room, params):
    log = part(room, slice(0, 30))
    moved = replace(log, odometry=se2.compose(np.array([300.0, -80.0, 2.0]), log.odometry))
    one, other = run_slam(log, params).trajectory.poses, run_slam(moved, params).trajectory.poses
    np.testing.assert_array_equal(one[0], 0.0)
    np.testing.assert_allclose(one, other, atol=1e-9)


@BOTH
def test_standing_still_adds_nothing(room, params):
    """300 scans from one place, each with its own noise: the first one's map, and no growing covariance.

    Without odometry every scan is looked at, and now and then one has a segment that the others have not.
    """
    ranges = np.tile(room.horizontal.ranges[:1], (300, 1))
    ranges += 0.01 * np.random.default_rng(0).normal(size=ranges.shape).astype(np.float32)
    scans = replace(room.horizontal, time_ns=np.arange(300) * 100_000_000, ranges=ranges)
    one = run_slam(part(room, slice(0, 1)), params)
    for odometry, more in ((np.zeros((300, 3)), 2), (None, len(one.lines.hits))):
        slam = run_slam(ScanLog(scans, odometry, None), params)
        assert np.abs(slam.trajectory.poses).max() < 0.01
        assert len(slam.lines.hits) <= len(one.lines.hits) + more
        assert np.sqrt(slam.trajectory.covariances[:, [0, 1, 2], [0, 1, 2]]).max() < 0.2


@BOTH
def test_scans_without_returns_are_bridged_by_odometry(room, params):
    log = part(room, slice(0, 60))
    ranges = log.horizontal.ranges.copy()
    ranges[5:15] = np.nan
    ranges[30] = np.nan
    slam = run_slam(with_ranges(log, ranges), params)
    assert slam.statistics.new[5:15].tolist() == [0] * 10
    assert align(slam.trajectory, simulated("room").truth).rms < 0.005


@BOTH
def test_first_scan_without_returns_starts_the_map_with_the_next(room, params):
    log = part(room, slice(0, 40))
    ranges = log.horizontal.ranges.copy()
    ranges[0] = np.nan
    slam = run_slam(with_ranges(log, ranges), params)
    assert slam.statistics.stored[0] == 0
    assert slam.statistics.stored[-1] > 4
    assert align(slam.trajectory, simulated("room").truth).rms < 0.005


@BOTH
def test_more_empty_scans_than_are_worked_on_at_once(room, params):
    """Whole batches without a return, before, between and after the others."""
    n = 300
    ranges = np.full((n, room.horizontal.ranges.shape[1]), np.nan, np.float32)
    ranges[140] = room.horizontal.ranges[0]
    scans = replace(room.horizontal, time_ns=np.arange(n) * 100_000_000, ranges=ranges)
    slam = run_slam(ScanLog(scans, np.zeros((n, 3)), None), params)
    assert set(slam.statistics.new.nonzero()[0].tolist()) <= {140}
    np.testing.assert_allclose(slam.trajectory.poses, 0.0, atol=1e-9)


@BOTH
def test_one_scan_gives_its_lines(room, params):
    slam = run_slam(part(room, slice(0, 1)), params)
    np.testing.assert_array_equal(slam.trajectory.poses, np.zeros((1, 3)))
    np.testing.assert_array_equal(slam.trajectory.covariances, np.zeros((1, 3, 3)))
    assert len(slam.lines.hits) == slam.statistics.new[0] > 4


@pytest.mark.parametrize("count", [0, 1, 50])
@BOTH
def test_log_without_any_return_is_refused(room, count, params):
    scans = replace(room.horizontal, time_ns=np.arange(count), ranges=np.full((count, 760), np.nan, np.float32))
    with pytest.raises(
        BadInputError, match=r"horizontal laser \(/laser_horizontal/scan\) has no scan with a valid range"
    ):
        run_slam(ScanLog(scans, np.zeros((count, 3)), None), params)


@BOTH
def test_stamps_that_step_back_or_repeat_do_no_harm(room, params):
    log = part(room, slice(0, 60))
    times = log.horizontal.time_ns.copy()
    times[20:25] = times[20:25][::-1]
    times[40] = times[41]
    slam = run_slam(replace(log, horizontal=replace(log.horizontal, time_ns=times)), params)
    np.testing.assert_array_equal(slam.trajectory.time_ns, times)
    np.testing.assert_allclose(slam.trajectory.poses, run_slam(log, params).trajectory.poses, atol=1e-9)


@BOTH
def test_laser_off_the_robots_centre_and_turned_gives_the_robots_poses(room, params):
    """The trajectory is that of base_link: seen with the mount wrong it would be off by the lever."""
    assert np.any(room.horizontal.mount[:2, 3] != 0)
    turned = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    log = part(room, slice(0, 60))
    scans = replace(log.horizontal, mount=log.horizontal.mount @ turned, angle_min=log.horizontal.angle_min - np.pi / 2)
    one, other = run_slam(log, params), run_slam(replace(log, horizontal=scans), params)
    np.testing.assert_allclose(one.trajectory.poses, other.trajectory.poses, atol=1e-6)


def test_progress_is_told_for_every_scan(room):
    told = []
    run_slam(part(room, slice(0, 10)), PAPER, track=lambda what, done, total: told.append((done, total)))
    assert told == [(k + 1, 10) for k in range(10)]


@BOTH
def test_given_sigma_is_used(room, params):
    log = part(room, slice(0, 30))
    fine, coarse = (run_slam(log, replace(params, range_sigma=sigma)) for sigma in (0.01, 0.05))
    assert coarse.lines.covariances[:, 1, 1].mean() > fine.lines.covariances[:, 1, 1].mean()


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["room", "corridor", "loop"])
@pytest.mark.parametrize("seed", [0, 1, 2])
@BOTH
def test_scenes_are_tracked_as_asked(scene, seed, params):
    simulation = simulated(scene, seed=seed)
    slam = run_slam(simulation.log, params)
    assert align(slam.trajectory, simulation.truth).rms < (0.02 if scene == "room" else 0.05)
    assert covariances_are_sound(slam)
