"""Point cloud: SlamMap -> PointCloud, the vertical scans placed by the trajectory, with covariance, Eq. (16)-(18)."""

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import gaussian, se2
from bsmap_cli.core.noise import range_sigma
from bsmap_cli.errors import BadInputError
from bsmap_cli.model import Array, IntArray, LaserScans, PointCloud, SlamMap, Trajectory
from bsmap_cli.params import CloudParams
from bsmap_cli.track import Track, silent


def make_cloud(slam_map: SlamMap, params: CloudParams, *, track: Track = silent) -> PointCloud:
    """Organised cloud in map; scans before the first or after the last pose are left out: nothing is extrapolated.

    Raises
    ------
    BadInputError
        There is no vertical laser, or none of its returns falls into the range limits and the trajectory's time.
    """
    scans = slam_map.vertical
    if scans is None:
        raise BadInputError("the log has no vertical laser: without one there is a trajectory, but no cloud")
    trajectory = _in_order(slam_map.trajectory)
    sigma = params.range_sigma or range_sigma(scans.ranges)
    inside = _covered(scans, trajectory)
    with np.errstate(invalid="ignore"):
        hit = (scans.ranges >= params.range_min) & (scans.ranges <= params.range_max) & inside[:, None]
    scan, beam = np.nonzero(hit)
    if len(scan) == 0:
        raise BadInputError(
            f"no return of the vertical laser ({scans.topic}) lies in the range limits and the trajectory's time"
        )
    track("cloud: scans", 0, 1)
    time_ns = scans.time_ns[scan] + np.rint(beam * scans.time_increment * 1e9).astype(np.int64)
    scan_poses = se2.interpolate(trajectory.time_ns, trajectory.poses, scans.time_ns)
    scan_covariances = _interpolated(trajectory, trajectory.covariances, scans.time_ns)
    poses = se2.interpolate(trajectory.time_ns, trajectory.poses, time_ns)
    ranges, angles = scans.ranges[scan, beam].astype(float), scans.angles[beam]
    points = beam_points(poses, scans.mount, ranges, angles)
    sensor = sensor_covariances(poses, scans.mount, ranges, angles, sigma, params.angle_sigma)
    modes = trajectory.modes
    pose = pose_covariances(points[:, :2] - poses[:, :2], scan_covariances[scan])
    track("cloud: scans", 1, 1)
    return PointCloud(
        points=points,
        scan_index=scan.astype(np.int32),
        beam_index=beam.astype(np.int32),
        time_ns=time_ns,
        covariances=gaussian.pack(sensor + pose),
        scan_time_ns=scans.time_ns,
        scan_poses=scan_poses,
        scan_pose_covariances=scan_covariances,
        mount=scans.mount,
        angle_min=scans.angle_min,
        angle_increment=scans.angle_increment,
        range_sigma=sigma,
        angle_sigma=params.angle_sigma,
        scan_pose_modes=None if modes is None else _interpolated(trajectory, modes, scans.time_ns),
    )


def beam_points(poses: Array, mount: Array, ranges: Array, angles: Array) -> Array:
    """(n, 3) ends of beams in map, Eq. (16)-(17): poses (n, 3) of base_link, mount (4, 4), ranges and angles (n,)."""
    beam = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), np.zeros_like(ranges)], axis=1)
    q = beam @ mount[:3, :3].T + mount[:3, 3]
    return np.concatenate([se2.transform(poses, q[:, :2]), q[:, 2:]], axis=1)


def sensor_covariances(
    poses: Array, mount: Array, ranges: Array, angles: Array, sigma_range: float, sigma_angle: float
) -> Array:
    """(n, 3, 3) in map, from the noise of range and direction: J_rho diag(.) J_rho' of Eq. (18)."""
    c, s, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
    along = np.stack([c, s, zero], axis=1) * sigma_range
    across = np.stack([-s, c, zero], axis=1) * (ranges * sigma_angle)[:, None]
    in_base = np.stack([along, across], axis=2)
    in_base = np.einsum("ij,njk->nik", mount[:3, :3], in_base)
    ct, st = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    x, y, z = in_base[:, 0], in_base[:, 1], in_base[:, 2]
    J = np.stack([ct * x - st * y, st * x + ct * y, z], axis=1)
    return J @ np.swapaxes(J, 1, 2)


def pose_covariances(lever: Array, pose_covariance: Array) -> Array:
    """(n, 3, 3) in map, from the pose's error: J_x P J_x' of Eq. (18).

    lever : (n, 2), from base_link to the point, in map.  pose_covariance : (n, 3, 3) of x, y, theta.
    """
    J = np.zeros((len(lever), 3, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2], J[:, 1, 2] = -lever[:, 1], lever[:, 0]
    return J @ pose_covariance @ np.swapaxes(J, 1, 2)


def _in_order(trajectory: Trajectory) -> Trajectory:
    """Trajectory by time; logs whose stamps step back list the poses in another order."""
    order = np.argsort(trajectory.time_ns, kind="stable")
    modes = None if trajectory.modes is None else trajectory.modes[order]
    return Trajectory(trajectory.time_ns[order], trajectory.poses[order], trajectory.covariances[order], modes)


def _covered(scans: LaserScans, trajectory: Trajectory) -> NDArray[np.bool_]:
    """(n,) whether the trajectory reaches over the whole of each scan, from its first beam to its last."""
    first, last = trajectory.time_ns[[0, -1]]
    takes = int(np.rint((scans.ranges.shape[1] - 1) * scans.time_increment * 1e9))
    return (scans.time_ns >= first) & (scans.time_ns + takes <= last)


def _interpolated(trajectory: Trajectory, matrices: Array, at_ns: IntArray) -> Array:
    """(k, a, b) of matrices (n, a, b) of the poses, linear between neighbours, whose errors are nearly the same."""
    origin = trajectory.time_ns[0]
    t, at = (trajectory.time_ns - origin).astype(float), (at_ns - origin).astype(float)
    columns = [np.interp(at, t, column) for column in matrices.reshape(len(t), -1).T]
    return np.array(columns).reshape(-1, len(at)).T.reshape(len(at), *matrices.shape[1:])
