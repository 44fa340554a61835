"""The artifact of `slam`: an MCAP file that Foxglove and rviz show as it is, and that comes back to the last bit.

| topic | type | holds |
|---|---|---|
| /tf_static | tf2_msgs/TFMessage | mounts of the lasers |
| /bsmap/slam | std_msgs/String | JSON: format, version, lasers, line map; all that is not one row a scan |
| /map/segments | visualization_msgs/MarkerArray | the line map |
| /trajectory | nav_msgs/Path | all poses |
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
from bsmap_cli.model import Array, LaserScans, LineMap, SlamMap, StepStatistics, Trajectory

VERSION = 1
STRING = "std_msgs/msg/String"
NUMBERS = "std_msgs/msg/Float64MultiArray"
STEP_COLUMNS = "theta new stored matched nis dof"
_READ = (STRING, NUMBERS, ros.POSE_WITH_COVARIANCE, ros.LASER_SCAN)
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
    yield "/bsmap/slam", ros.make(STRING, data=json.dumps(_header(slam), separators=(",", ":")))
    yield "/map/segments", ros.make(ros.MARKER_ARRAY, markers=_markers(slam.lines, slam.horizontal_mount[2, 3], start))
    yield "/trajectory", _path(slam.trajectory, start)


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
    }


def _markers(lines: LineMap, height: float, start: int) -> list[Any]:
    """One LINE_LIST of all segments at the laser's height; none where there are no lines, for rviz complains."""
    alpha, r = lines.parameters.T
    normal, along = np.column_stack([np.cos(alpha), np.sin(alpha)]), np.column_stack([-np.sin(alpha), np.cos(alpha)])
    foot = normal * r[:, None]
    ends = np.stack([foot + along * lines.extents[:, [k]] for k in (0, 1)], axis=1).reshape(-1, 2)
    marker = ros.make(
        "visualization_msgs/msg/Marker",
        header=ros.header(start, "map"),
        ns="segments",
        id=0,
        type=5,  # LINE_LIST
        action=0,
        pose=ros.pose_message((0.0, 0.0, 0.0)),
        scale=ros.make("geometry_msgs/msg/Vector3", x=0.03, y=0.0, z=0.0),
        color=ros.make("std_msgs/msg/ColorRGBA", r=0.1, g=0.5, b=1.0, a=1.0),
        lifetime=ros.make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=[ros.make("geometry_msgs/msg/Point", x=x, y=y, z=float(height)) for x, y in ends.tolist()],
        colors=[],
        texture_resource="",
        texture=ros.make(
            "sensor_msgs/msg/CompressedImage", header=ros.header(0, ""), format="", data=np.zeros(0, np.uint8)
        ),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=ros.make("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
        mesh_use_embedded_materials=False,
    )
    return [marker] if len(ends) else []


def _path(trajectory: Trajectory, start: int) -> Any:
    poses = [
        ros.make("geometry_msgs/msg/PoseStamped", header=ros.header(t, "map"), pose=ros.pose_message(pose))
        for t, pose in zip(trajectory.time_ns.tolist(), trajectory.poses, strict=True)
    ]
    return ros.make(ros.PATH, header=ros.header(start, "map"), poses=poses)


def _steps(slam: SlamMap) -> Iterator[_Messages]:
    """Pose, transform and statistics of each horizontal scan."""
    trajectory, s = slam.trajectory, slam.statistics
    numbers = np.column_stack([trajectory.poses[:, 2], s.new, s.stored, s.matched, s.nis, s.dof])
    for k, t in enumerate(trajectory.time_ns.tolist()):
        pose, covariance = trajectory.poses[k], trajectory.covariances[k]
        stamped = ros.make(
            ros.POSE_WITH_COVARIANCE, header=ros.header(t, "map"), pose=ros.pose_with_covariance(pose, covariance)
        )
        tf = ros.tf_message([ros.transform_message(planar_matrix(pose), t, "map", "base_link")])
        yield _Messages(t, (("/pose", stamped), ("/tf", tf), ("/bsmap/steps", _numbers(numbers[k]))))


def planar_matrix(pose: Array) -> Array:
    """Matrix (4, 4) of a planar pose (3,) x, y, theta."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array([[c, -s, 0, pose[0]], [s, c, 0, pose[1]], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def _numbers(row: Array) -> Any:
    dimension = ros.make("std_msgs/msg/MultiArrayDimension", label=STEP_COLUMNS, size=len(row), stride=len(row))
    layout = ros.make("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
    return ros.make(NUMBERS, layout=layout, data=row)


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
        trajectory=_trajectory(poses, numbers[:, 0]),
        lines=_lines(header["lines"]),
        statistics=_statistics(numbers),
        vertical=vertical and _laser(vertical, messages.get(vertical["topic"], [])),
        horizontal_mount=np.array(header["horizontal"]["mount"]),
        horizontal_frame_id=header["horizontal"]["frame_id"],
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


def _trajectory(poses: list[Any], theta: Array) -> Trajectory:
    points = [(message.pose.pose.position.x, message.pose.pose.position.y) for message in poses]
    covariances = [message.pose.covariance.reshape(6, 6)[ros.PLANAR] for message in poses]
    return Trajectory(
        time_ns=np.array([ros.time_of(message) for message in poses], dtype=np.int64),
        poses=np.column_stack([np.array(points).reshape(-1, 2), theta]),
        covariances=np.array(covariances).reshape(-1, 3, 3),
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
