"""ROS 2 messages and what they mean here: stamps as integer nanoseconds, poses and mounts as arrays.

Types and their definitions come from rosbags' type store (ROS 2 Humble), (de)serialised as CDR.
"""

import math
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.typesys import Stores, get_typestore

from bsmap_cli.model import Array, LaserScans

LASER_SCAN = "sensor_msgs/msg/LaserScan"
ODOMETRY = "nav_msgs/msg/Odometry"
TF_MESSAGE = "tf2_msgs/msg/TFMessage"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
PATH = "nav_msgs/msg/Path"
MARKER_ARRAY = "visualization_msgs/msg/MarkerArray"
STRING = "std_msgs/msg/String"
NUMBERS = "std_msgs/msg/Float64MultiArray"

NANOSECONDS = 1_000_000_000
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


def decode(data: bytes, type_name: str) -> Any:
    """Message from its CDR."""
    return typestore().deserialize_cdr(data, type_name)


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
    return _transform(matrix[:3, 3].tolist(), quaternion_from_matrix(matrix[:3, :3]).tolist(), time_ns, parent, child)


def planar_transform_message(pose: Array, time_ns: int, parent: str, child: str) -> Any:
    """The same for a planar pose x, y, theta."""
    x, y, theta = pose.tolist()
    return _transform((x, y, 0.0), _about_z(theta), time_ns, parent, child)


def _transform(translation: Sequence[float], quaternion: Sequence[float], time_ns: int, parent: str, child: str) -> Any:
    return make(
        "geometry_msgs/msg/TransformStamped",
        header=header(time_ns, parent),
        child_frame_id=child,
        transform=make(
            "geometry_msgs/msg/Transform",
            translation=make("geometry_msgs/msg/Vector3", **dict(zip("xyz", translation, strict=True))),
            rotation=make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", quaternion, strict=True))),
        ),
    )


def _about_z(theta: float) -> tuple[float, float, float, float]:
    """Quaternion x, y, z, w of a rotation by theta, radians."""
    return 0.0, 0.0, math.sin(theta / 2), math.cos(theta / 2)


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
    x, y, theta = np.asarray(pose, dtype=float).tolist()
    return make(
        "geometry_msgs/msg/Pose",
        position=make("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
        orientation=make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", _about_z(theta), strict=True))),
    )


def planar_pose(pose: Any) -> tuple[float, float, float]:
    """x, y, yaw of a geometry_msgs/Pose."""
    q = pose.orientation
    yaw = np.arctan2(2 * (q.w * q.z + q.x * q.y), q.w**2 + q.x**2 - q.y**2 - q.z**2)
    return pose.position.x, pose.position.y, float(yaw)


def pose_with_covariance(pose: ArrayLike, covariance: Array | None = None) -> Any:
    """geometry_msgs/PoseWithCovariance of x, y, theta and its covariance (3, 3); zeros (unknown) without."""
    full = np.zeros((6, 6))
    if covariance is not None:
        full[PLANAR] = covariance
    return make("geometry_msgs/msg/PoseWithCovariance", pose=pose_message(pose), covariance=full.ravel())


def odometry_message(time_ns: int, pose: ArrayLike, frame_id: str = "odom", child_frame_id: str = "base_link") -> Any:
    """nav_msgs/Odometry of a pose; covariances and speeds are left at zero, which means unknown."""
    zero = make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return make(
        ODOMETRY,
        header=header(time_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=pose_with_covariance(pose),
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
