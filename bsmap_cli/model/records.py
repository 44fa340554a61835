"""Logs, trajectories and point clouds: ScanLog -> SlamMap -> PointCloud."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.model.arrays import Array, IntArray, check


@dataclass(frozen=True)
class LaserScans:
    """All scans of one laser, in the order in which the log holds them.

    time_ns : (n,) int64, stamp of each scan's first beam. Usually ascending; some logs step back.
    ranges : (n, m) float32, metres along the beam; nan is "no return" (anything out of limits was made nan).
    angle_min, angle_increment : angle of beam 0 and step to the next, radians in the laser's frame.
    time_increment : seconds between neighbouring beams; 0 where a scan counts as taken at once.
    range_min, range_max : metres, limits of valid returns.
    mount : (4, 4), T_base_laser, maps laser coordinates to base_link.
    """

    time_ns: IntArray
    ranges: NDArray[np.float32]
    angle_min: float
    angle_increment: float
    time_increment: float
    range_min: float
    range_max: float
    mount: Array
    frame_id: str = ""
    topic: str = ""

    def __post_init__(self) -> None:
        n = len(self.time_ns)
        check(self, time_ns=(n,), ranges=(n, None), mount=(4, 4))

    @property
    def angles(self) -> Array:
        """(m,) beam angles, radians."""
        return self.angle_min + self.angle_increment * np.arange(self.ranges.shape[1], dtype=np.float64)


@dataclass(frozen=True)
class ScanLog:
    """A robot's log: the horizontal laser's scans, odometry at each of them, and the vertical laser's scans.

    odometry : (n, 3) x, y, theta of base_link in the odometry frame at each horizontal scan; None without odometry.
    """

    horizontal: LaserScans
    odometry: Array | None
    vertical: LaserScans | None

    def __post_init__(self) -> None:
        if self.odometry is not None:
            check(self, odometry=(len(self.horizontal.time_ns), 3))


@dataclass(frozen=True)
class Trajectory:
    """Poses of base_link in map.

    time_ns : (n,) int64.  poses : (n, 3) x, y, theta.  covariances : (n, 3, 3), of (x, y, theta) in map, marginal.
    modes : (n, 3, k) what the poses' errors have in common: that of pose i is modes_i z and one of its own, z ~ N(0, I)
    being the same for all; so poses i and j have the covariance modes_i modes_j'. None where that is not known.
    """

    time_ns: IntArray
    poses: Array
    covariances: Array
    modes: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.time_ns)
        check(self, time_ns=(n,), poses=(n, 3), covariances=(n, 3, 3))
        if self.modes is not None:
            check(self, modes=(n, 3, None))


@dataclass(frozen=True)
class LineMap:
    """Line segments in map: points p with p . n = r, n = (cos alpha, sin alpha), r >= 0.

    parameters : (m, 2) alpha, r.  covariances : (m, 2, 2), marginal.
    extents : (m, 2) from t0 to t1 along t = (-sin alpha, cos alpha), metres.
    sides : (m,) +1 where the robot saw the segment from the side to which n points, -1 from the origin's side.
    hits : (m,) number of scans in which it was seen.
    """

    parameters: Array
    covariances: Array
    extents: Array
    sides: IntArray
    hits: IntArray

    def __post_init__(self) -> None:
        m = len(self.parameters)
        check(self, parameters=(m, 2), covariances=(m, 2, 2), extents=(m, 2), sides=(m,), hits=(m,))


def segment_ends(lines: LineMap) -> Array:
    """(m, 2, 2) both end points of each segment, in map."""
    alpha, r = lines.parameters.T
    n, t = np.stack([np.cos(alpha), np.sin(alpha)], -1), np.stack([-np.sin(alpha), np.cos(alpha)], -1)
    return (n * r[:, None])[:, None] + t[:, None] * lines.extents[..., None]


@dataclass(frozen=True)
class StepStatistics:
    """What each step of the filter did (the paper's Figure 11), one row a horizontal scan.

    new, stored, matched : (n,) segments seen in the scan, lines stored after the step, pairs matched in it.
    nis : (n,) sum of the normalised innovation squared of the step's pairs.  dof : (n,) its degrees of freedom.
    """

    new: IntArray
    stored: IntArray
    matched: IntArray
    nis: Array
    dof: IntArray

    def __post_init__(self) -> None:
        n = len(self.new)
        check(self, new=(n,), stored=(n,), matched=(n,), nis=(n,), dof=(n,))


@dataclass(frozen=True)
class LoopClosures:
    """Pairs of horizontal scans that were matched with each other because the robot seemed to be there again.

    first, second : (m,) numbers of the scans.  relative : (m, 3) pose of base_link at the second scan in its frame at
    the first one, as measured.  held : (m,) whether the trajectory follows it; False where it was refused.
    """

    first: IntArray
    second: IntArray
    relative: Array
    held: NDArray[np.bool_]

    def __post_init__(self) -> None:
        m = len(self.first)
        check(self, first=(m,), second=(m,), relative=(m, 3), held=(m,))


def no_closures() -> LoopClosures:
    """No loops at all."""
    return LoopClosures(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0, bool))


@dataclass(frozen=True)
class SlamMap:
    """Trajectory at the horizontal scans, line map, statistics; the vertical scans are carried on for the cloud.

    tracked_poses : (n, 3) of base_link in map, before loops were closed and all was smoothed; None where nothing was.
    """

    trajectory: Trajectory
    lines: LineMap
    statistics: StepStatistics
    vertical: LaserScans | None
    horizontal_mount: Array
    horizontal_frame_id: str = "laser_horizontal"
    closures: LoopClosures = field(default_factory=no_closures)
    tracked_poses: Array | None = None

    def __post_init__(self) -> None:
        if self.tracked_poses is not None:
            check(self, tracked_poses=(len(self.trajectory.time_ns), 3))


@dataclass(frozen=True)
class PointCloud:
    """Organised cloud of the vertical laser, in map.

    points : (n, 3).  scan_index, beam_index : (n,) int32, ascending by scan, then beam.  time_ns : (n,) int64.
    covariances : (n, 6) xx, xy, xz, yy, yz, zz: sensor and pose part together, Eq. (18).
    scan_time_ns : (m,), scan_poses : (m, 3), scan_pose_covariances : (m, 3, 3): base_link at each vertical scan; with
    them the pose part J_x P J_x' of a point's covariance can be told from the sensor part.
    scan_pose_modes : (m, 3, k), what the errors of these poses have in common, as in Trajectory; or None.
    mount, angle_min, angle_increment : of the vertical laser, as in LaserScans, so that a point's beam can be had back.
    range_sigma, angle_sigma : metres, radians, the sensor noise in `covariances`.
    """

    points: Array
    scan_index: NDArray[np.int32]
    beam_index: NDArray[np.int32]
    time_ns: IntArray
    covariances: Array
    scan_time_ns: IntArray
    scan_poses: Array
    scan_pose_covariances: Array
    mount: Array
    angle_min: float
    angle_increment: float
    range_sigma: float
    angle_sigma: float
    scan_pose_modes: Array | None = None

    def __post_init__(self) -> None:
        n, m = len(self.points), len(self.scan_time_ns)
        if self.scan_pose_modes is not None:
            check(self, scan_pose_modes=(m, 3, None))
        check(self, points=(n, 3), scan_index=(n,), beam_index=(n,), time_ns=(n,), covariances=(n, 6))
        check(self, scan_time_ns=(m,), scan_poses=(m, 3), scan_pose_covariances=(m, 3, 3), mount=(4, 4))


@dataclass(frozen=True)
class ScatteredCloud:
    """Points without scans, beams and poses, whose order means nothing.

    points : (n, 3) metres, in map.
    """

    points: Array

    def __post_init__(self) -> None:
        check(self, points=(None, 3))
