"""Scan lines of a data set: the points of its scans in the order of the beams, with the sensor's covariance."""

import hashlib
from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.core.gaussian import pack
from bsmap_cli.fit.movement import Movement
from bsmap_cli.model import Array, IntArray, PointCloud, PosePart

OWN_REACH = (0.3, 0.3)
"""Metres and radians over which a pose's own error stays the same: slam interpolates between key scans so far apart."""
LEAST_SHARE = 0.5
"""Of the median number of points of a data set's scans, that a scan must have."""


class ScanLines(NamedTuple):
    """Points of a data set, scan after scan in order of movement, beam after beam.

    points : (n, 3) in map.  line : (n,) number of the scan line, 0 ... lines - 1, ascending.  beam : (n,) ascending.
    covariances : (n, 6) in map, sensor part, packed.
    """

    points: Array
    line: IntArray
    beam: IntArray
    covariances: Array

    @property
    def n_lines(self) -> int:
        """Number of scan lines."""
        return int(self.line[-1]) + 1 if len(self.line) else 0


def gather_lines(cloud: PointCloud, movement: Movement, fewest: int) -> ScanLines:
    """Scan lines of a data set.

    Scans with less than `fewest` points, or less than half as many as usual in the set, are left out: every knot needs
    data in every scan line, so that one poor scan would keep the whole surface stiff.
    """
    start, stop = np.searchsorted(cloud.scan_index, np.stack([movement.scans, movement.scans + 1]))
    counts = stop - start
    kept = np.flatnonzero((counts >= fewest) & (counts >= LEAST_SHARE * np.median(counts)))
    ranges = [np.arange(start[k], stop[k]) for k in kept]
    index = np.concatenate([*ranges, np.zeros(0, dtype=np.int64)]).astype(np.int64)
    line = np.repeat(np.arange(len(kept)), counts[kept])
    return ScanLines(
        cloud.points[index], line, cloud.beam_index[index].astype(np.int64), _sensor_covariances(cloud, index)
    )


def _sensor_covariances(cloud: PointCloud, index: IntArray) -> Array:
    """Sensor part J_rho diag(sigma_rho^2, sigma_phi^2) J_rho' of Eq. (18), (n, 6) in map, of points `index` (n,).

    Computed anew from the beams: taking the pose part from the whole would leave rounding errors of its size.
    """
    pose = cloud.scan_poses[cloud.scan_index[index]]
    phi = cloud.angle_min + cloud.angle_increment * cloud.beam_index[index]
    zero = np.zeros_like(phi)
    along = np.stack([np.cos(phi), np.sin(phi), zero], axis=1) @ cloud.mount[:3, :3].T
    across = np.stack([-np.sin(phi), np.cos(phi), zero], axis=1) @ cloud.mount[:3, :3].T
    origin = np.column_stack([se2.transform(pose, cloud.mount[:2, 3]), np.full(len(index), cloud.mount[2, 3])])
    distance = np.linalg.norm(cloud.points[index] - origin, axis=1)
    along, across = _turn(pose[:, 2], along), _turn(pose[:, 2], across)
    across *= (cloud.angle_sigma * distance)[:, None]
    along *= cloud.range_sigma
    return pack(along[:, :, None] * along[:, None, :] + across[:, :, None] * across[:, None, :])


def _turn(theta: Array, vectors: Array) -> Array:
    """Vectors (n, 3) turned by theta (n,) about z."""
    c, s = np.cos(theta), np.sin(theta)
    x, y, z = vectors.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def pose_part(cloud: PointCloud, movement: Movement, name: str) -> PosePart:
    """Error of pose common to a data set: the mean of its scans' errors, each turned about the mean position.

    Of these the modes are known to all scans; what a pose errs by on its own is taken to be one over OWN_REACH, so that
    the mean over a longer way has a share of it. Where nothing is known of modes, all poses are taken to err together.
    """
    poses, covariances = cloud.scan_poses[movement.scans], cloud.scan_pose_covariances[movement.scans]
    centre = poses[:, :2].mean(axis=0)
    J = np.tile(np.eye(3), (len(poses), 1, 1))
    J[:, 0, 2] = poses[:, 1] - centre[1]
    J[:, 1, 2] = centre[0] - poses[:, 0]
    whole = (J @ covariances @ np.swapaxes(J, 1, 2)).mean(axis=0)
    if cloud.scan_pose_modes is None:
        return PosePart(name, centre, (whole + whole.T) / 2)
    of_scans = J @ cloud.scan_pose_modes[movement.scans]
    own = whole - (of_scans @ np.swapaxes(of_scans, 1, 2)).mean(axis=0)
    modes = of_scans.mean(axis=0)
    covariance = modes @ modes.T + own / _independent(poses)
    trajectory = hashlib.sha256(cloud.scan_pose_modes.tobytes()).hexdigest()[:8]
    return PosePart(name, centre, (covariance + covariance.T) / 2, modes=modes, trajectory=trajectory)


def _independent(poses: Array) -> float:
    """How many poses (n, 3) err on their own, by the way and the turns between them."""
    steps = se2.between(poses[:-1], poses[1:])
    way = np.hypot(steps[:, 0], steps[:, 1]).sum() / OWN_REACH[0], np.abs(steps[:, 2]).sum() / OWN_REACH[1]
    return float(np.clip(max(way), 1.0, len(poses)))
