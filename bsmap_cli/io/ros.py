"""ROS 2 messages and what they mean here: stamps as integer nanoseconds, poses and mounts as arrays.

Types and their definitions come from rosbags' type store (ROS 2 Humble), (de)serialised as CDR.
"""

import math
import struct
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.typesys import Stores, get_typestore

from bsmap_cli.model import Array, IntArray, LaserScans

LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
PATH = "nav_msgs/msg/Path"
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
STRING = "std_msgs/msg/String"
NUMBERS = "std_msgs/msg/Float64MultiArray"

NANOSECONDS = 1_000_000_000
_STAMP_MARK = 1_234_567_890_123_456_789
_STAMP, _POSE, _ODOMETRY_NUMBERS = struct.Struct("<iI"), struct.Struct("<7d"), 7 + 36 + 6 + 36
# Rows and columns of x, y, theta in the 6 x 6 covariance of a ROS pose (x, y, z, roll, pitch, yaw).
PLANAR = np.ix_((0, 1, 5), (0, 1, 5))


@cache
def typestore() -> Any:
    """The ROS 2 types."""
    return get_typestore(Stores.ROS2_HUMBLE)


@cache
def schema_text(type_name: str) -> bytes:
    """Definition of a message type and all that it uses, as MCAP's schema encoding `ros2msg` wants it."""
    return str(typestore().generate_msgdef(type_name, ros_version=2)[0]).encode()


def encode(message: Any) -> bytes:
    """CDR of a message of the type store."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def encode_alike(message_of: Callable[[int, Array], Any], time_ns: IntArray, numbers: Array) -> list[bytes]:
    """CDR of messages that differ by stamp and numbers alone: `encode(message_of(t, row))` of each, made at once.

    CDR lays out messages alike whose strings and arrays are equally long. So one is encoded with marks in the places of
    its stamp and numbers, and the others are copies of it with those of their own.

    message_of : message of a stamp in ns and numbers (k,), each of which goes as it is into one field of 64 bits.
    time_ns : (n,).  numbers : (n, k).
    """
    seconds, nanoseconds = np.divmod(np.asarray(time_ns, np.int64), NANOSECONDS)
    stamps = np.stack([seconds, nanoseconds], axis=1).astype("<u4").view(np.uint8)
    values = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
    marks = np.pi + np.arange(numbers.shape[1], dtype=np.float64)
    example = encode(message_of(_STAMP_MARK, marks))
    fields = [(np.array(divmod(_STAMP_MARK, NANOSECONDS), "<u4").tobytes(), stamps)]
    fields += [(mark.tobytes(), values[:, 8 * k : 8 * k + 8]) for k, mark in enumerate(marks)]
    copies = np.tile(np.frombuffer(example, np.uint8), (len(stamps), 1))
    for mark, field in fields:
        if example.count(mark) > 1:
            raise ValueError("a stamp or number stands in the message more than once")
        if (at := example.find(mark)) >= 0:
            copies[:, at : at + 8] = field
    return [copy.tobytes() for copy in copies]


def decode(data: bytes, type_name: str) -> Any:
    """Message from its CDR."""
    return typestore().deserialize_cdr(data, type_name)


class Alike(NamedTuple):
    """What messages of a topic have in common if they differ by stamp and by the numbers from a place on alone.

    Then these can be read from where they stand in the CDR, without decoding the rest of each message again.

    size : bytes of a message.  common : places that are alike in all, and what stands there.  start : of the numbers.
    """

    size: int
    common: tuple[tuple[slice, bytes], ...]
    start: int

    def fits(self, data: bytes) -> bool:
        """Whether a message is one of them."""
        return len(data) == self.size and all(data[place] == known for place, known in self.common)


def alike_scans(data: bytes, scan: Any) -> Alike | None:
    """Those that have frame, angles, limits and numbers of ranges and intensities of this LaserScan; None: ask each."""
    count = len(scan.ranges)
    start = len(data) - 4 * (count + 1 + len(scan.intensities))
    alike = _alike(data, scan, start, start + 4 * count, 4)
    return alike if alike and count and ranges_at(data, start, count).tobytes() == scan.ranges.tobytes() else None


def alike_odometry(data: bytes, odometry: Any) -> Alike | None:
    """Those that have the frames of this Odometry, of which all that follows is of one length; None: ask each."""
    start = len(data) - 8 * _ODOMETRY_NUMBERS
    alike = _alike(data, odometry, start, len(data), 0)
    return alike if alike and pose_at(data, start) == planar_pose(odometry.pose.pose) else None


def _alike(data: bytes, message: Any, start: int, end: int, after: int) -> Alike | None:
    """Alike but for the stamp and what is from `start` to `end`; `after`: bytes that tell the length of the rest."""
    if data[:2] != b"\x00\x01" or start < 12 or stamp_at(data) != time_of(message):
        return None
    places = slice(0, 4), slice(12, start), slice(end, end + after)
    return Alike(len(data), tuple((place, data[place]) for place in places), start)


def stamp_at(data: bytes) -> int:
    """Header stamp, ns, of a message that begins with its header."""
    seconds, nanoseconds = _STAMP.unpack_from(data, 4)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def pose_at(data: bytes, start: int) -> tuple[float, float, float]:
    """x, y, yaw of the geometry_msgs/Pose at a place."""
    x, y, _, *quaternion = _POSE.unpack_from(data, start)
    return x, y, _yaw(*quaternion)


def ranges_at(data: bytes, start: int, count: int) -> NDArray[np.float32]:
    """So many ranges (count,) at a place."""
    return np.frombuffer(data, "<f4", count, start)


def make(type_name: str, **fields: Any) -> Any:
    """Message of a type by its full name, for instance `nav_msgs/msg/Odometry`."""
    return typestore().types[type_name](**fields)


def time_message(time_ns: int) -> Any:
    """builtin_interfaces/Time."""
    seconds, nanoseconds = divmod(int(time_ns), NANOSECONDS)
    return make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def time_of(message: Any) -> int:
    """Header stamp of a message, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def header(time_ns: int, frame_id: str) -> Any:
    """std_msgs/Header."""
    return make("std_msgs/msg/Header", stamp=time_message(time_ns), frame_id=frame_id)


def quaternion_from_matrix(rotation: ArrayLike) -> Array:
    """Unit quaternion (4,) x, y, z, w of a rotation matrix (3, 3), w >= 0."""
    R = np.asarray(rotation, dtype=float)
    # Bar-Itzhack 2000: the eigenvector of the largest eigenvalue; no case is near a division by zero.
    K = np.array(
        [
            [R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0], R[2, 1] - R[1, 2]],
            [R[0, 1] + R[1, 0], R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1], R[0, 2] - R[2, 0]],
            [R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], R[2, 2] - R[0, 0] - R[1, 1], R[1, 0] - R[0, 1]],
            [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], R[0, 0] + R[1, 1] + R[2, 2]],
        ]
    )
    q = np.linalg.eigh(K)[1][:, -1]
    return np.asarray(q if q[3] >= 0 else -q)


def matrix_from_quaternion(q: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of a quaternion x, y, z, w; it need not be of unit length, but not zero."""
    x, y, z, w = np.asarray(q, dtype=float) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def transform_message(matrix: Array, time_ns: int, parent: str, child: str) -> Any:
    """geometry_msgs/TransformStamped that maps `child` coordinates to `parent`; matrix (4, 4)."""
    return _transform(matrix[:3, 3], quaternion_from_matrix(matrix[:3, :3]), time_ns, parent, child)


def planar_transform(numbers: Array, time_ns: int, parent: str, child: str) -> Any:
    """geometry_msgs/TransformStamped of `pose_numbers` (4,)."""
    x, y, qz, qw = numbers
    return _transform(np.array([x, y, 0.0]), np.array([0.0, 0.0, qz, qw]), time_ns, parent, child)


def _transform(place: Array, quaternion: Array, time_ns: int, parent: str, child: str) -> Any:
    x, y, z, w = quaternion.tolist()
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(time_ns, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", **dict(zip("xyz", place.tolist(), strict=True))),
            rotation=make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        ),
    )


def tf_message(transforms: Sequence[Any]) -> Any:
    """tf2_msgs/TFMessage."""
    return make(TF_MESSAGE, transforms=list(transforms))


def matrix_of(transform: Any) -> Array:
    """Matrix (4, 4) of a geometry_msgs/Transform."""
    T = np.eye(4)
    q = transform.rotation
    T[:3, :3] = matrix_from_quaternion((q.x, q.y, q.z, q.w))
    T[:3, 3] = transform.translation.x, transform.translation.y, transform.translation.z
    return T


def pose_message(pose: ArrayLike) -> Any:
    """geometry_msgs/Pose of a planar pose x, y, theta."""
    return pose_of_numbers(pose_numbers(np.asarray(pose, dtype=float)))


def pose_numbers(poses: Array) -> Array:
    """(..., 4) numbers of a pose message that are not 0: x, y, z and w of the quaternion of poses (..., 3)."""
    half = poses[..., 2] / 2
    return np.stack([poses[..., 0], poses[..., 1], np.sin(half), np.cos(half)], axis=-1)


def pose_of_numbers(numbers: Array) -> Any:
    """geometry_msgs/Pose of `pose_numbers` (4,)."""
    x, y, qz, qw = numbers.tolist()
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
        orientation=make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=qz, w=qw),
    )


def encode_path(time_ns: IntArray, poses: Array, start: int) -> bytes:
    """CDR of a nav_msgs/Path in map of poses (n, 3) with stamps (n,), itself stamped `start`, both ns."""

    def stamped(t: int, numbers: Array) -> Any:
        return make("geometry_msgs/msg/PoseStamped", header=header(t, "map"), pose=pose_of_numbers(numbers))

    def path(some: list[Any]) -> bytes:
        return encode(make(PATH, header=header(start, "map"), poses=some))

    numbers = pose_numbers(poses)
    if len(poses) == 0:
        return path([])
    # The number of poses stands last in a path without any. The first pose ends at a multiple of 8 bytes, from which
    # on the others stand as they do alone, less the 4 bytes that tell the encoding.
    count, first = len(path([])) - 4, path([stamped(int(time_ns[0]), numbers[0])])
    others = encode_alike(stamped, time_ns[1:], numbers[1:])
    head = first[:count] + np.array(len(poses), "<u4").tobytes() + first[count + 4 :]
    return b"".join([head, *(other[4:] for other in others)])


def planar_pose(pose: Any) -> tuple[float, float, float]:
    """x, y, yaw of a geometry_msgs/Pose."""
    q = pose.orientation
    return pose.position.x, pose.position.y, _yaw(q.x, q.y, q.z, q.w)


def _yaw(x: float, y: float, z: float, w: float) -> float:
    """Yaw of a quaternion of any length."""
    return math.atan2(2 * (w * z + x * y), w**2 + x**2 - y**2 - z**2)


def pose_with_covariance(pose: Any, covariance: Array | None = None) -> Any:
    """geometry_msgs/PoseWithCovariance of a Pose and the covariance (3, 3) of x, y, theta; zeros (unknown) without."""
    full = np.zeros((6, 6))
    if covariance is not None:
        full[PLANAR] = covariance
    return make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=full.ravel())


def odometry_message(time_ns: int, pose: ArrayLike, frame_id: str = "odom", child_frame_id: str = "base_link") -> Any:
    """nav_msgs/Odometry of a pose; covariances and speeds are left at zero, which means unknown."""
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return make(
        ODOMETRY,
        header=header(time_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=pose_with_covariance(pose_message(pose)),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def scan_of(scans: LaserScans, time_ns: int, ranges: NDArray[np.float32]) -> Any:
    """sensor_msgs/LaserScan of one scan of a laser; nan ("no return") is written as infinity, as REP-117 has it."""
    return make(
        LASER_SCAN,
        header=header(time_ns, scans.frame_id),
        angle_min=scans.angle_min,
        angle_max=scans.angle_min + scans.angle_increment * (len(ranges) - 1),
        angle_increment=scans.angle_increment,
        time_increment=scans.time_increment,
        scan_time=scans.time_increment * len(ranges),
        range_min=scans.range_min,
        range_max=scans.range_max,
        ranges=np.where(np.isnan(ranges), np.float32(np.inf), ranges).astype(np.float32),
        intensities=np.zeros(0, np.float32),
    )


def numbers_message(rows: Array, label: str) -> Any:
    """std_msgs/Float64MultiArray of an array (..., k); `label` names the k columns."""
    dimension = make("std_msgs/msg/MultiArrayDimension", label=label, size=rows.shape[-1], stride=rows.shape[-1])
    layout = make("std_msgs/msg/MultiArrayLayout", dim=[dimension], data_offset=0)
    return make(NUMBERS, layout=layout, data=rows.ravel())


def line_list_message(name: str, ends: Array, colors: ArrayLike, width: float, height: float, time_ns: int) -> Any:
    """visualization_msgs/MarkerArray of line segments in map; empty where there are none, for rviz complains.

    ends : (m, 2, 2), metres.  colors : (m, 3) or (3,), red, green, blue from 0 to 1.  height : metres above the floor.
    """
    points = [make("geometry_msgs/msg/Point", x=x, y=y, z=float(height)) for x, y in ends.reshape(-1, 2).tolist()]
    each = np.broadcast_to(np.asarray(colors, dtype=float), (len(ends), 3)).repeat(2, axis=0)
    colored = [make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=1.0) for r, g, b in each.tolist()]
    empty = np.zeros(0, np.uint8)
    marker = make(
        "visualization_msgs/msg/Marker",
        header=header(time_ns, "map"),
        ns=name,
        id=0,
        type=5,  # LINE_LIST
        action=0,
        pose=pose_message((0.0, 0.0, 0.0)),
        scale=make("geometry_msgs/msg/Vector3", x=width, y=0.0, z=0.0),
        color=colored[0] if colored else None,
        lifetime=make("builtin_interfaces/msg/Duration", sec=0, nanosec=0),
        frame_locked=False,
        points=points,
        colors=colored,
        texture_resource="",
        texture=make("sensor_msgs/msg/CompressedImage", header=header(0, ""), format="", data=empty),
        uv_coordinates=[],
        text="",
        mesh_resource="",
        mesh_file=make("visualization_msgs/msg/MeshFile", filename="", data=empty),
        mesh_use_embedded_materials=False,
    )
    return make(MARKER_ARRAY, markers=[marker] if points else [])
