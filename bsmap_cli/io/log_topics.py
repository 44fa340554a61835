"""What a log's topics hold, decoded topic by topic into arrays; which topic plays which part is decided in log.py."""

import logging
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.errors import BadInputError
from bsmap_cli.io import ros
from bsmap_cli.io.mcap_file import McapMessage, read_messages
from bsmap_cli.model import Array, IntArray, LaserScans

logger = logging.getLogger("bsmap")


@dataclass
class ScanTopic:
    """Scans of one laser as they came. `geometry` holds angle_min, angle_increment, time_increment, range limits."""

    frame_id: str
    time_ns: list[int] = field(default_factory=list)
    log_time: list[int] = field(default_factory=list)
    ranges: list[NDArray[np.float32]] = field(default_factory=list)
    geometry: list[tuple[float, float, float, float, float]] = field(default_factory=list)


@dataclass
class OdometryTopic:
    """Odometry as it came: `poses` are x, y, yaw of the child frame."""

    child_frame_id: str
    time_ns: list[int] = field(default_factory=list)
    log_time: list[int] = field(default_factory=list)
    poses: list[tuple[float, float, float]] = field(default_factory=list)


@dataclass
class LogTopics:
    """All of a log. `transforms` and `moving`: child frame -> (parent frame, T_parent_child), the first of each."""

    path: Path
    types: dict[str, str] = field(default_factory=dict)
    log_times: dict[str, list[int]] = field(default_factory=dict)
    scans: dict[str, ScanTopic] = field(default_factory=dict)
    odometry: dict[str, OdometryTopic] = field(default_factory=dict)
    transforms: dict[str, tuple[str, Array]] = field(default_factory=dict)
    moving: dict[str, tuple[str, Array]] = field(default_factory=dict)

    def summary(self) -> str:
        """The topics in one line, for an error message."""
        return ", ".join(
            f"{topic} ({self.types[topic] or 'no type'}, {len(times)})" for topic, times in self.log_times.items()
        )


def read_topics(path: Path | str) -> LogTopics:
    """Decode a log; messages of other types are counted only.

    Raises
    ------
    MissingInputError, BadInputError
        As `read_messages`; or no message of a type that is known could be decoded.
    """
    topics, broken = LogTopics(Path(path)), Counter[str]()
    for message in read_messages(path):
        topics.types.setdefault(message.topic, message.type_name)
        topics.log_times.setdefault(message.topic, []).append(message.log_time)
        take = _TAKERS.get(message.type_name)
        if take is None:
            continue
        try:
            take(topics, message, ros.decode(message.data, message.type_name))
        except Exception as error:  # rosbags raises whatever the damaged bytes lead it to
            broken[f"{message.topic} ({type(error).__name__}: {error})"] += 1
    if broken:
        first = next(iter(broken))
        logger.warning("%s: %d messages could not be decoded, first %s", path, broken.total(), first)
    return topics


def _take_scan(topics: LogTopics, message: McapMessage, scan: Any) -> None:
    topic = topics.scans.setdefault(message.topic, ScanTopic(scan.header.frame_id.lstrip("/")))
    topic.time_ns.append(ros.time_of(scan))
    topic.log_time.append(message.log_time)
    topic.ranges.append(scan.ranges)
    geometry = (scan.angle_min, scan.angle_increment, scan.time_increment, scan.range_min, scan.range_max)
    topic.geometry.append(geometry)


def _take_odometry(topics: LogTopics, message: McapMessage, odometry: Any) -> None:
    topic = topics.odometry.setdefault(message.topic, OdometryTopic(odometry.child_frame_id.lstrip("/")))
    topic.time_ns.append(ros.time_of(odometry))
    topic.log_time.append(message.log_time)
    topic.poses.append(ros.planar_pose(odometry.pose.pose))


def _take_transforms(topics: LogTopics, message: McapMessage, tf: Any) -> None:
    tree = topics.transforms if message.topic.endswith("tf_static") else topics.moving
    for transform in tf.transforms:
        child = transform.child_frame_id.lstrip("/")
        if child not in tree:
            tree[child] = transform.header.frame_id.lstrip("/"), ros.matrix_of(transform.transform)


_TAKERS: dict[str, Callable[[LogTopics, McapMessage, Any], None]] = {
    ros.LASER_SCAN: _take_scan,
    ros.ODOMETRY: _take_odometry,
    ros.TF_MESSAGE: _take_transforms,
}


def laser_scans(path: Path, name: str, topic: ScanTopic, mount: Array) -> tuple[LaserScans, IntArray]:
    """Scans of a topic as one array, and their log times (n,) ns.

    Ranges out of limits become nan, and so do 0 and the largest one, which stand for no return in many logs; short
    scans are padded with nan, and scans whose angles are not those of most of the topic's scans are dropped with a
    warning.
    """
    geometry = np.array(topic.geometry, dtype=float)
    rounded = [(round(row[0], 5), round(row[1], 7)) for row in topic.geometry]
    common, count = Counter(rounded).most_common(1)[0]
    keep = [i for i, row in enumerate(rounded) if row == common]
    if count < len(rounded):
        logger.warning(
            "%s: %s: %d of %d scans dropped, for their angle_min or angle_increment differ from the others'",
            *(path, name, len(rounded) - count, len(rounded)),
        )
    ranges = _padded([topic.ranges[i] for i in keep])
    if ranges.shape[1] == 0:
        raise BadInputError(f"{path}: {name}: its scans have no beams")
    low, high = geometry[keep, 3, None], geometry[keep, 4, None]
    with np.errstate(invalid="ignore"):
        # Many drivers tell a beam without return by the largest range or by 0: a robot would carry a wall around it.
        ranges[~((ranges >= low) & (ranges > 0.0) & (ranges < high))] = np.nan
    angle_min, angle_increment, time_increment, *_ = topic.geometry[keep[0]]
    scans = LaserScans(
        time_ns=np.array(topic.time_ns, dtype=np.int64)[keep],
        ranges=ranges,
        angle_min=angle_min,
        angle_increment=angle_increment,
        time_increment=time_increment,
        range_min=float(low.min()),
        range_max=float(high.max()),
        mount=mount,
        frame_id=topic.frame_id,
        topic=name,
    )
    return scans, np.array(topic.log_time, dtype=np.int64)[keep]


def _padded(rows: list[NDArray[np.float32]]) -> NDArray[np.float32]:
    """Rows as one array, (n, longest) float32, short ones filled with nan."""
    width = max(len(row) for row in rows)
    if all(len(row) == width for row in rows):
        return np.array(rows, dtype=np.float32)
    padded = np.full((len(rows), width), np.nan, dtype=np.float32)
    for padded_row, row in zip(padded, rows, strict=True):
        padded_row[: len(row)] = row
    return padded
