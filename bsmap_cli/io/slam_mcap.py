"""The artifact of `slam`: an MCAP file that Foxglove and rviz show as it is, and that comes back to the last bit.

| topic | type | holds |
|---|---|---|
| /tf_static | tf2_msgs/TFMessage | mounts of the lasers |
| /bsmap/slam | std_msgs/String | JSON: format, version, lasers, line map, loops; all that is not one row a scan |
| /map/segments | visualization_msgs/MarkerArray | the line map |
| /map/closures | visualization_msgs/MarkerArray | loops: green where they hold, red where they were refused |
| /trajectory | nav_msgs/Path | all poses |
| /trajectory_tracked | nav_msgs/Path | all poses before loops were closed |
| /bsmap/tracked | std_msgs/Float64MultiArray | the same poses, x, y, theta |
| /bsmap/modes | std_msgs/Float64MultiArray | what the poses' errors have in common, see `Trajectory`; where known |
| /pose | geometry_msgs/PoseWithCovarianceStamped | pose of base_link in map and its covariance, one a horizontal scan |
| /tf | tf2_msgs/TFMessage | map -> base_link, the same poses |
| /bsmap/steps | std_msgs/Float64MultiArray | theta, new, stored, matched, nis, dof of each step |
| the vertical laser's | sensor_msgs/LaserScan | its scans, as in the log |

What holds for the whole map comes first, so that a viewer shows it at any time. theta stands in /bsmap/steps because
a quaternion does not give it back exactly.
"""

import json
from collections.abc import Iterator
from heapq import merge
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from bsmap_cli.errors import BadInputError
from bsmap_cli.io import ros
from bsmap_cli.io.artifact import Provenance
from bsmap_cli.io.mcap_file import RosWriter, read_messages, ros_writer
from bsmap_cli.model import (
    Array,
    IntArray,
    LaserScans,
    LineMap,
    LoopClosures,
    SlamMap,
    StepStatistics,
    Trajectory,
    segment_ends,
)

VERSION = 3
STEP_COLUMNS = "theta new stored matched nis dof"
_READ = (ros.STRING, ros.NUMBERS, ros.POSE_WITH_COVARIANCE, ros.LASER_SCAN)
SEGMENT_COLOR, HELD_COLOR, REFUSED_COLOR = (0.1, 0.5, 1.0), (0.1, 0.8, 0.2), (0.9, 0.2, 0.1)
_LASER_FIELDS = ("angle_min", "angle_increment", "time_increment", "range_min", "range_max", "frame_id", "topic")


class _Messages(NamedTuple):
    """Messages of one moment, by topic."""

    time_ns: int
    by_topic: tuple[tuple[str, Any], ...]


def write_slam(path: Path | str, slam: SlamMap, provenance: Provenance | None = None) -> None:
    """Write the artifact of `slam`; CannotWriteError where that fails.

    Messages come in the order of time, each topic's in the order of its scans; the time of logging is the stamp, and
    goes on by a nanosecond where stamps step back.
    """
    if len(slam.statistics.new) != len(slam.trajectory.time_ns):
        raise ValueError(f"{len(slam.statistics.new)} steps for {len(slam.trajectory.time_ns)} poses")
    rows = merge(_steps(slam), _vertical_scans(slam.vertical), key=lambda row: row.time_ns)
    start = min(_first_times(slam), default=0)
    with ros_writer(path, provenance) as writer:
        _write_at(writer, _Messages(start, tuple(_map_messages(slam, start))), start)
        log_time = start
        for row in rows:
            log_time = max(row.time_ns, log_time + 1)
            _write_at(writer, row, log_time)


def _first_times(slam: SlamMap) -> Iterator[int]:
    for times in (slam.trajectory.time_ns, slam.vertical.time_ns if slam.vertical else ()):
        if len(times):
            yield int(np.min(times))


def _write_at(writer: RosWriter, row: _Messages, log_time: int) -> None:
    for topic, message in row.by_topic:
        writer.write(topic, message, log_time)


def _map_messages(slam: SlamMap, start: int) -> Iterator[tuple[str, Any]]:
    """What holds for the whole map."""
    mounts = {slam.horizontal_frame_id: slam.horizontal_mount}
    if slam.vertical is not None:
        mounts[slam.vertical.frame_id] = slam.vertical.mount
    transforms = [ros.transform_message(T, start, "base_link", frame) for frame, T in mounts.items()]
    yield "/tf_static", ros.tf_message(transforms)
    yield "/bsmap/slam", ros.make(ros.STRING, data=json.dumps(_header(slam), separators=(",", ":")))
    height = slam.horizontal_mount[2, 3]
    segments = segment_ends(slam.lines)
    yield "/map/segments", ros.line_list_message("segments", segments, SEGMENT_COLOR, 0.03, height, start)
    loops = slam.closures
    chords = np.stack([slam.trajectory.poses[loops.first, :2], slam.trajectory.poses[loops.second, :2]], axis=1)
    colors = np.where(loops.held[:, None], HELD_COLOR, REFUSED_COLOR)
    yield "/map/closures", ros.line_list_message("closures", chords, colors, 0.05, height, start)
    yield "/trajectory", _path(slam.trajectory.time_ns, slam.trajectory.poses, start)
    if slam.tracked_poses is not None:
        yield "/trajectory_tracked", _path(slam.trajectory.time_ns, slam.tracked_poses, start)
        yield "/bsmap/tracked", ros.numbers_message(slam.tracked_poses, "x y theta")
    if slam.trajectory.modes is not None:
        yield "/bsmap/modes", ros.numbers_message(slam.trajectory.modes, "modes of x, y, theta")


def _header(slam: SlamMap) -> dict[str, Any]:
    vertical = None
    if slam.vertical is not None:
        vertical = {name: getattr(slam.vertical, name) for name in _LASER_FIELDS}
        vertical |= {"mount": slam.vertical.mount.tolist(), "beams": slam.vertical.ranges.shape[1]}
    return {
        "format": "bsmap-slam",
        "version": VERSION,
        "horizontal": {"frame_id": slam.horizontal_frame_id, "mount": slam.horizontal_mount.tolist()},
        "vertical": vertical,
        "lines": {name: np.asarray(values).tolist() for name, values in vars(slam.lines).items()},
        "closures": {name: np.asarray(values).tolist() for name, values in vars(slam.closures).items()},
    }


def _path(time_ns: IntArray, poses: Array, start: int) -> Any:
    stamped = [
        ros.make("geometry_msgs/msg/PoseStamped", header=ros.header(t, "map"), pose=ros.pose_message(pose))
        for t, pose in zip(time_ns.tolist(), poses, strict=True)
    ]
    return ros.make(ros.PATH, header=ros.header(start, "map"), poses=stamped)


def _steps(slam: SlamMap) -> Iterator[_Messages]:
    """Pose, transform and statistics of each horizontal scan."""
    trajectory, s = slam.trajectory, slam.statistics
    numbers = np.column_stack([trajectory.poses[:, 2], s.new, s.stored, s.matched, s.nis, s.dof])
    for k, t in enumerate(trajectory.time_ns.tolist()):
        pose, covariance = trajectory.poses[k], trajectory.covariances[k]
        stamped = ros.make(
            ros.POSE_WITH_COVARIANCE, header=ros.header(t, "map"), pose=ros.pose_with_covariance(pose, covariance)
        )
        tf = ros.tf_message([ros.planar_transform_message(pose, t, "map", "base_link")])
        yield _Messages(
            t, (("/pose", stamped), ("/tf", tf), ("/bsmap/steps", ros.numbers_message(numbers[k], STEP_COLUMNS)))
        )


def _vertical_scans(vertical: LaserScans | None) -> Iterator[_Messages]:
    if vertical is not None:
        for t, ranges in zip(vertical.time_ns.tolist(), vertical.ranges, strict=True):
            yield _Messages(t, ((vertical.topic, ros.scan_of(vertical, t, ranges)),))


def read_slam(path: Path | str) -> SlamMap:
    """Read the artifact of `slam`, exactly as it was written.

    Raises
    ------
    MissingInputError
        There is no such file.
    BadInputError
        It is not an artifact of `slam`, of another version, cut or damaged.
    """
    messages: dict[str, list[Any]] = {}
    for message in read_messages(path, whole=True):
        if message.type_name in _READ:
            messages.setdefault(message.topic, []).append(ros.decode(message.data, message.type_name))
    header = _checked_header(path, messages)
    poses, steps = messages.get("/pose", []), messages.get("/bsmap/steps", [])
    if len(poses) != len(steps):
        raise BadInputError(f"{path}: {len(poses)} poses, but {len(steps)} steps; run `bsmap slam` again")
    numbers = np.array([step.data for step in steps], dtype=float).reshape(-1, len(STEP_COLUMNS.split()))
    vertical = header["vertical"]
    return SlamMap(
        trajectory=_trajectory(poses, numbers[:, 0], messages.get("/bsmap/modes", [])),
        lines=_lines(header["lines"]),
        statistics=_statistics(numbers),
        vertical=vertical and _laser(vertical, messages.get(vertical["topic"], [])),
        horizontal_mount=np.array(header["horizontal"]["mount"]),
        horizontal_frame_id=header["horizontal"]["frame_id"],
        closures=_closures(header["closures"]),
        tracked_poses=_tracked(messages.get("/bsmap/tracked", [])),
    )


def _checked_header(path: Path | str, messages: dict[str, list[Any]]) -> dict[str, Any]:
    if "/bsmap/slam" not in messages:
        raise BadInputError(f"{path}: is not an artifact of `bsmap slam`; is it a log? Run `bsmap slam` on it first")
    header: dict[str, Any] = json.loads(messages["/bsmap/slam"][0].data)
    if header["version"] != VERSION:
        raise BadInputError(
            f"{path}: is of version {header['version']}, this bsmap reads {VERSION}; run `bsmap slam` again"
        )
    return header


def _trajectory(poses: list[Any], theta: Array, modes: list[Any]) -> Trajectory:
    points = [(message.pose.pose.position.x, message.pose.pose.position.y) for message in poses]
    covariances = [message.pose.covariance.reshape(6, 6)[ros.PLANAR] for message in poses]
    return Trajectory(
        time_ns=np.array([ros.time_of(message) for message in poses], dtype=np.int64),
        poses=np.column_stack([np.array(points).reshape(-1, 2), theta]),
        covariances=np.array(covariances).reshape(-1, 3, 3),
        modes=np.array(modes[0].data, dtype=float).reshape(len(poses), 3, -1) if modes else None,
    )


def _lines(plain: dict[str, Any]) -> LineMap:
    m = len(plain["parameters"])
    return LineMap(
        parameters=np.array(plain["parameters"], dtype=float).reshape(m, 2),
        covariances=np.array(plain["covariances"], dtype=float).reshape(m, 2, 2),
        extents=np.array(plain["extents"], dtype=float).reshape(m, 2),
        sides=np.array(plain["sides"], dtype=np.int64),
        hits=np.array(plain["hits"], dtype=np.int64),
    )


def _closures(plain: dict[str, Any]) -> LoopClosures:
    return LoopClosures(
        first=np.array(plain["first"], dtype=np.int64),
        second=np.array(plain["second"], dtype=np.int64),
        relative=np.array(plain["relative"], dtype=float).reshape(-1, 3),
        held=np.array(plain["held"], dtype=bool),
    )


def _tracked(messages: list[Any]) -> Array | None:
    return np.array(messages[0].data, dtype=float).reshape(-1, 3) if messages else None


def _statistics(numbers: Array) -> StepStatistics:
    counts = numbers.astype(np.int64)
    return StepStatistics(
        new=counts[:, 1], stored=counts[:, 2], matched=counts[:, 3], nis=numbers[:, 4], dof=counts[:, 5]
    )


def _laser(plain: dict[str, Any], scans: list[Any]) -> LaserScans:
    ranges = np.array([scan.ranges for scan in scans], dtype=np.float32).reshape(-1, plain["beams"])
    ranges[~np.isfinite(ranges)] = np.nan
    return LaserScans(
        time_ns=np.array([ros.time_of(scan) for scan in scans], dtype=np.int64),
        ranges=ranges,
        mount=np.array(plain["mount"]),
        **{name: plain[name] for name in _LASER_FIELDS},
    )
