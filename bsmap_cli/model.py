"""What flows between the stages: ScanLog -> SlamMap -> PointCloud -> SurfaceMap (of data sets, then of the map).

All of it is frozen and checked for shape when made. Units: metres, radians; times are integer nanoseconds, as in ROS
stamps (a float64 of seconds since 1970 holds only 0.2 microseconds). Frames: `map`, `base_link` (x forward, y left,
z up), and the two laser frames, in which a beam at angle phi points to (cos phi, sin phi, 0).
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]


def _check(owner: object, **shapes: tuple[int | None, ...]) -> None:
    """Raise ValueError where an attribute's array has not the shape named (None: any length)."""
    for name, shape in shapes.items():
        got = np.shape(getattr(owner, name))
        if len(got) != len(shape) or any(s is not None and s != g for s, g in zip(shape, got, strict=True)):
            wanted = "(" + ", ".join("any" if s is None else str(s) for s in shape) + ")"
            raise ValueError(f"{type(owner).__name__}.{name} has shape {got}, wanted {wanted}")


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
        _check(self, time_ns=(n,), ranges=(n, None), mount=(4, 4))

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
            _check(self, odometry=(len(self.horizontal.time_ns), 3))


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
        _check(self, time_ns=(n,), poses=(n, 3), covariances=(n, 3, 3))
        if self.modes is not None:
            _check(self, modes=(n, 3, None))


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
        _check(self, parameters=(m, 2), covariances=(m, 2, 2), extents=(m, 2), sides=(m,), hits=(m,))


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
        _check(self, new=(n,), stored=(n,), matched=(n,), nis=(n,), dof=(n,))


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
        _check(self, first=(m,), second=(m,), relative=(m, 3), held=(m,))


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
            _check(self, tracked_poses=(len(self.trajectory.time_ns), 3))


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
            _check(self, scan_pose_modes=(m, 3, None))
        _check(self, points=(n, 3), scan_index=(n,), beam_index=(n,), time_ns=(n,), covariances=(n, 6))
        _check(self, scan_time_ns=(m,), scan_poses=(m, 3), scan_pose_covariances=(m, 3, 3), mount=(4, 4))


@dataclass(frozen=True)
class ScatteredCloud:
    """Points without scans, beams and poses, whose order means nothing.

    points : (n, 3) metres, in map.
    """

    points: Array

    def __post_init__(self) -> None:
        _check(self, points=(None, 3))


@dataclass(frozen=True)
class PosePart:
    """Error that all points of a data set share, for it comes from the robot's pose.

    covariance : (3, 3) of (x, y, theta) in map; a rotation by theta turns about `centre` (2,), metres in map.
    weight : share of this data set in the surface (1 before merging); the shares of a surface's parts add up to 1.
    modes : (3, k) of that covariance what the data sets of one trajectory have in common, as in Trajectory; sets a and
    b of the same `trajectory` have the covariance modes_a modes_b', others none. None where it is not known.
    A point p has the covariance  J C J',  J = [[1, 0, -(p_y - c_y)], [0, 1, p_x - c_x], [0, 0, 0]].
    """

    data_set: str
    centre: Array
    covariance: Array
    weight: float = 1.0
    modes: Array | None = None
    trajectory: str = ""

    def __post_init__(self) -> None:
        _check(self, centre=(2,), covariance=(3, 3))
        if self.modes is not None:
            _check(self, modes=(3, None))

    @property
    def own(self) -> Array:
        """(3, 3) covariance of what this data set has in common with no other."""
        return self.covariance if self.modes is None else self.covariance - self.modes @ self.modes.T


@dataclass(frozen=True)
class SurfaceCovariance:
    """Covariance of a surface's control points: a sensor part and the pose parts of its data sets.

    Sensor part of control points (i, j) and (k, l):  L_ij (rho_u[i, k] rho_v[j, l]) L_kl',  L the symmetric square
    roots of `blocks`. The blocks on the diagonal are exact (A C_Q A', Eq. 32-33); the correlation is that of equal
    noise on all points, which is separable: an approximation that keeps the map small and any point's covariance at
    hand.

    blocks : (nu, nv, 6) xx, xy, xz, yy, yz, zz.  correlation_u : (nu, nu).  correlation_v : (nv, nv).
    """

    blocks: Array
    correlation_u: Array
    correlation_v: Array
    pose: tuple[PosePart, ...]

    def __post_init__(self) -> None:
        nu, nv = np.shape(self.correlation_u)[0], np.shape(self.correlation_v)[0]
        _check(self, blocks=(nu, nv, 6), correlation_u=(nu, nu), correlation_v=(nv, nv))


@dataclass(frozen=True)
class HeightCovariance:
    """Covariance of a surface whose control points move along given directions only: a sensor part and pose parts.

    The surface was fitted as a field of scalar heights; control point (i, j) moves by its height along its direction.
    A point S(u, v) has the sensor part G M G', column (i, j) of G being N_i(u) N_j(v) d_ij: exact, and small.

    directions : (nu or 1, nv or 1, 3) unit vectors in map; where there is 1, it holds for all.
    matrix : (nu * nv, nu * nv) of the heights, square metres, heights in the order of the control points.
    """

    directions: Array
    matrix: Array
    pose: tuple[PosePart, ...]

    def __post_init__(self) -> None:
        size = len(self.matrix)
        _check(self, directions=(None, None, 3), matrix=(size, size))


@dataclass(frozen=True)
class TrimLoop:
    """Closed polygon in a surface's parameters.

    parameters : (k, 2) u, v in [0, 1].
    creases : (k,) number in SurfaceMap.creases of the crease that the side from this vertex to the next one runs
    along, -1 for an open border.
    """

    parameters: Array
    creases: IntArray

    def __post_init__(self) -> None:
        _check(self, parameters=(None, 2), creases=(len(self.parameters),))


@dataclass(frozen=True)
class Crease:
    """Curve in which two surfaces meet: a polyline (k, 3) in map, which the trim loops of both refer to.

    corners : numbers in SurfaceMap.corners of its first and its last point, -1 for a free end.
    """

    surfaces: tuple[str, str]
    points: Array
    corners: tuple[int, int] = (-1, -1)

    def __post_init__(self) -> None:
        _check(self, points=(None, 3))


@dataclass(frozen=True)
class Residuals:
    """Distances of the data to the surface at the parameters of the fit, metres."""

    points: int
    mean: float
    rms: float
    percentile_95: float
    maximum: float


@dataclass(frozen=True)
class BSplineSurface:
    """Tensor-product B-spline surface S(u, v) on [0, 1] x [0, 1] in map, Eq. (19).

    knots_u : (nu + p + 1,), knots_v : (nv + q + 1,), clamped.  control_points : (nu, nv, 3).
    name : of the surface, unique in its map.  data_sets : it was fitted to.
    trims : what of it was seen: the points around which the loops together wind counter-clockwise, holes being run
    around clockwise. Loops may overlap. Without trims it is the whole surface.
    """

    name: str
    data_sets: tuple[str, ...]
    degree_u: int
    degree_v: int
    knots_u: Array
    knots_v: Array
    control_points: Array
    covariance: SurfaceCovariance | HeightCovariance
    residuals: Residuals
    trims: tuple[TrimLoop, ...] = ()

    def __post_init__(self) -> None:
        nu, nv = len(self.knots_u) - self.degree_u - 1, len(self.knots_v) - self.degree_v - 1
        _check(self, control_points=(nu, nv, 3))
        if isinstance(self.covariance, HeightCovariance):
            fits = len(self.covariance.matrix) == nu * nv
            fits &= all(k in (1, n) for k, n in zip(self.covariance.directions.shape, (nu, nv), strict=False))
            shape: tuple[int, ...] = self.covariance.matrix.shape
        else:
            shape = np.shape(self.covariance.blocks)
            fits = shape == (nu, nv, 6)
        if not fits:
            raise ValueError(f"covariance of shape {shape} for {nu} x {nv} control points")


@dataclass(frozen=True)
class DataSet:
    """A run of vertical scans in one kind of movement, from which surfaces were fitted; or points without any order.

    movement : "translation", "rotation", or "unorganised" (then without scans: first and last are 0).
    """

    name: str
    movement: str
    first_scan: int
    last_scan: int
    points: int


@dataclass(frozen=True)
class Decision:
    """What merging did with two surfaces or patches, and why."""

    first: str
    second: str
    outcome: str  # "merged" or "refused"
    reason: str
    figures: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class SurfaceMap:
    """B-spline surfaces, of data sets (after fit) or of the map (after merge).

    creases : to which the trims of the surfaces refer.  corners : (k, 3) in map, points in which creases end together.
    """

    surfaces: tuple[BSplineSurface, ...]
    data_sets: tuple[DataSet, ...]
    decisions: tuple[Decision, ...] = ()
    notes: dict[str, Any] = field(default_factory=dict)
    creases: tuple[Crease, ...] = ()
    corners: Array = field(default_factory=lambda: np.zeros((0, 3)))

    def __post_init__(self) -> None:
        _check(self, corners=(None, 3))
