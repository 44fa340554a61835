"""The point cloud: places and covariances of beams, what is left out, the order of everything."""

from dataclasses import replace

import numpy as np
import pytest
from reference import central_differences
from scenes import simulated, true_slam_map
from scipy.stats import chi2

from bsmap_cli import cloud
from bsmap_cli.core.gaussian import unpack
from bsmap_cli.errors import BadInputError
from bsmap_cli.evaluate import distance_to_mesh, transform_points
from bsmap_cli.model import LaserScans, LineMap, SlamMap, StepStatistics, Trajectory
from bsmap_cli.params import CloudParams

START = 1_700_000_000_000_000_000
SECOND = 1_000_000_000
ACROSS = np.array([[0.0, 0, 1, -0.05], [0, 1, 0, 0.1], [-1, 0, 0, 0.6], [0, 0, 0, 1]])
"""T_base_laser of a laser whose scan plane stands upright across the robot's way."""


def slam_map(
    poses: np.ndarray, ranges: np.ndarray, laser_ns: np.ndarray | None = None, time_increment: float = 0.0
) -> SlamMap:
    """Poses a second apart; vertical scans with them, or at times `laser_ns` after the first."""
    n, none = len(poses), np.zeros(0, int)
    time_ns = START + SECOND * np.arange(n)
    counts = np.zeros(n, int)
    laser_ns = time_ns if laser_ns is None else START + laser_ns
    scans = LaserScans(
        laser_ns, ranges.astype(np.float32), -1.0, 0.5, time_increment, 0.1, 30, ACROSS, "laser_vertical", "/vertical"
    )
    covariances = np.tile(np.diag([0.01, 0.02, 0.005]) ** 2, (n, 1, 1)) * (1 + np.arange(n))[:, None, None]
    return SlamMap(
        Trajectory(time_ns, poses, covariances),
        LineMap(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros((0, 2)), none, none),
        StepStatistics(counts, counts, counts, np.zeros(n), counts),
        scans,
        np.eye(4),
    )


def random_map(n: int = 6, beams: int = 5) -> SlamMap:
    rng = np.random.default_rng(0)
    return slam_map(rng.uniform([-9, -9, -3], [9, 9, 3], (n, 3)), rng.uniform(1, 8, (n, beams)))


def place(pose: np.ndarray, mount: np.ndarray, rho: float, phi: float) -> np.ndarray:
    """End of one beam by homogeneous matrices, Eq. (16)-(17)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    T = np.array([[c, -s, 0, pose[0]], [s, c, 0, pose[1]], [0, 0, 1, 0], [0, 0, 0, 1]])
    return (T @ mount @ [rho * np.cos(phi), rho * np.sin(phi), 0, 1])[:3]


def test_points_are_products_of_matrices():
    slam = random_map()
    made = cloud.make_cloud(slam, CloudParams())
    scans = slam.vertical
    for k in range(len(made.points)):
        scan, beam = made.scan_index[k], made.beam_index[k]
        rho, phi = float(scans.ranges[scan, beam]), scans.angles[beam]
        wanted = place(slam.trajectory.poses[scan], scans.mount, rho, phi)
        np.testing.assert_allclose(made.points[k], wanted, atol=1e-12)


def test_covariances_match_central_differences():
    """C = J diag(P, sigma_rho^2, sigma_phi^2) J', J of the whole way from pose, range and direction to the point."""
    slam, params = random_map(), CloudParams(range_sigma=0.02, angle_sigma=0.003)
    made = cloud.make_cloud(slam, params)
    for k, C in enumerate(unpack(made.covariances)):
        scan, beam = made.scan_index[k], made.beam_index[k]
        at = np.r_[slam.trajectory.poses[scan], slam.vertical.ranges[scan, beam], slam.vertical.angles[beam]]
        J = central_differences(lambda x: place(x[:3], ACROSS, x[3], x[4]), at)
        noise = np.zeros((5, 5))
        noise[:3, :3], noise[3, 3], noise[4, 4] = slam.trajectory.covariances[scan], 0.02**2, 0.003**2
        np.testing.assert_allclose(C, J @ noise @ J.T, atol=1e-9)


def test_covariance_is_calibrated():
    """Normalised squared errors of noisy beams from noisy poses have their chi-square mean."""
    pose, P, rho, phi = np.array([3.0, -2.0, 1.0]), np.diag([0.01, 0.02, 0.004]) ** 2, 4.0, 0.7
    sensor = cloud.sensor_covariances(pose[None], ACROSS, np.array([rho]), np.array([phi]), 0.01, 0.002)
    truth = place(pose, ACROSS, rho, phi)
    C = (sensor + cloud.pose_covariances(truth[None, :2] - pose[:2], P[None]))[0]
    rng, n = np.random.default_rng(1), 4000
    poses = rng.multivariate_normal(pose, P, n)
    points = cloud.beam_points(poses, ACROSS, rho + 0.01 * rng.normal(size=n), phi + 0.002 * rng.normal(size=n))
    nees = np.einsum("ki,ij,kj->k", points - truth, np.linalg.inv(C), points - truth)
    low, high = chi2.ppf([1e-3, 1 - 1e-3], 3 * n) / n
    assert low < nees.mean() < high


def test_pose_part_can_be_had_back_from_what_the_cloud_keeps():
    made = cloud.make_cloud(random_map(), CloudParams())
    poses = made.scan_poses[made.scan_index]
    angles = made.angle_min + made.angle_increment * made.beam_index
    q = made.points - np.c_[poses[:, :2], np.zeros(len(poses))]
    pose = cloud.pose_covariances(q[:, :2], made.scan_pose_covariances[made.scan_index])
    ranges = random_map().vertical.ranges[made.scan_index, made.beam_index].astype(float)
    sensor = cloud.sensor_covariances(poses, made.mount, ranges, angles, made.range_sigma, made.angle_sigma)
    np.testing.assert_allclose(unpack(made.covariances), sensor + pose, atol=1e-15)


def test_beams_are_placed_where_the_robot_was_at_their_own_time():
    poses = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    made = cloud.make_cloud(slam_map(poses, np.full((1, 5), 2.0), np.array([0]), time_increment=0.2), CloudParams())
    np.testing.assert_array_equal(made.time_ns - START, SECOND // 5 * np.arange(5))
    still = cloud.make_cloud(slam_map(poses, np.full((1, 5), 2.0), np.array([0])), CloudParams())
    np.testing.assert_allclose(made.points - still.points, np.c_[0.2 * np.arange(5), np.zeros((5, 2))], atol=1e-9)


def test_scans_between_poses_are_interpolated_with_their_covariance():
    poses = np.array([[0.0, 0, 3.0], [2.0, 0, -3.0]])
    slam = slam_map(poses, np.full((1, 5), 2.0), np.array([SECOND // 2]))
    made = cloud.make_cloud(slam, CloudParams())
    bulge = np.tan((2 * np.pi - 6.0) / 4)  # of the arc over the chord of 2 m; the robot drives backwards
    np.testing.assert_allclose(made.scan_poses[0, :2], [1, -bulge], atol=1e-12)
    assert abs(made.scan_poses[0, 2]) == pytest.approx(np.pi)
    np.testing.assert_allclose(made.scan_pose_covariances[0], slam.trajectory.covariances.mean(axis=0))


def test_scans_the_trajectory_does_not_reach_are_left_out_whole():
    """Before the first pose, after the last, and with beams after the last; those on the very ends stay."""
    poses = np.zeros((3, 3))
    at = np.array([-1, 0, SECOND, 2 * SECOND, 2 * SECOND + 1])
    made = cloud.make_cloud(slam_map(poses, np.full((5, 5), 2.0), at), CloudParams())
    assert np.unique(made.scan_index).tolist() == [1, 2, 3]
    made = cloud.make_cloud(slam_map(poses, np.full((5, 5), 2.0), at, time_increment=0.01), CloudParams())
    assert np.unique(made.scan_index).tolist() == [1, 2]
    assert len(made.scan_poses) == 5  # scans keep their numbers


def test_trajectory_whose_stamps_step_back_is_taken_by_time():
    slam = random_map()
    order = np.array([0, 2, 1, 3, 5, 4])
    t = slam.trajectory
    shuffled = replace(slam, trajectory=Trajectory(t.time_ns[order], t.poses[order], t.covariances[order]))
    one, other = (cloud.make_cloud(s, CloudParams()) for s in (slam, shuffled))
    np.testing.assert_array_equal(one.points, other.points)
    np.testing.assert_array_equal(one.covariances, other.covariances)


def test_missing_returns_and_range_limits_leave_gaps_in_the_order():
    ranges = np.array([[np.nan, 1.0, 2.0, 3.0, 9.0], [np.nan] * 5, [5.0, np.nan, 0.5, 1.0, np.nan]])
    made = cloud.make_cloud(slam_map(np.zeros((3, 3)), ranges), CloudParams(range_min=1.0, range_max=5.0))
    assert list(zip(made.scan_index.tolist(), made.beam_index.tolist(), strict=True)) == [
        (0, 1), (0, 2), (0, 3), (2, 0), (2, 3),
    ]  # fmt: skip


def test_nothing_to_place_is_refused_with_the_reason():
    with pytest.raises(BadInputError, match="has no vertical laser: without one there is a trajectory, but no cloud"):
        cloud.make_cloud(replace(random_map(), vertical=None), CloudParams())
    for slam, params in (
        (random_map(), CloudParams(range_min=20.0)),
        (slam_map(np.zeros((2, 3)), np.full((1, 5), 2.0), np.array([9 * SECOND])), CloudParams()),
        (slam_map(np.zeros((2, 3)), np.full((2, 5), np.nan)), CloudParams()),
        (slam_map(np.zeros((2, 3)), np.zeros((0, 5)), np.zeros(0, int)), CloudParams()),
    ):
        with pytest.raises(
            BadInputError, match=r"no return of the vertical laser \(/vertical\) lies in the range limits"
        ):
            cloud.make_cloud(slam, params)


@pytest.mark.parametrize("scene", ["room", "corridor"])
def test_cloud_of_true_poses_lies_on_the_scene(scene):
    """Within the noise of 0.01 m along the beam; in motion too, where each beam has its own pose."""
    simulation = simulated(scene)
    made = cloud.make_cloud(true_slam_map(simulation), CloudParams())
    first = simulation.truth.poses[np.searchsorted(simulation.truth.time_ns, simulation.log.horizontal.time_ns[0])]
    points = transform_points(first, made.points)[::7]
    distances = distance_to_mesh(points, simulation.vertices, simulation.triangles)
    assert np.sqrt(np.mean(distances**2)) < 0.0105
    assert made.range_sigma == pytest.approx(0.01, rel=0.1)
