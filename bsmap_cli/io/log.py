"""Robot logs: MCAP files of ROS 2 messages, two sensor_msgs/LaserScan, nav_msgs/Odometry, mounts on /tf_static."""

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from heapq import merge
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from bsmap_cli.core import se2
from bsmap_cli.errors import BadInputError
from bsmap_cli.io import ros
from bsmap_cli.io.artifact import Provenance
from bsmap_cli.io.log_topics import LogTopics, OdometryTopic, laser_scans, read_topics
from bsmap_cli.io.mcap_file import RosWriter, ros_writer
from bsmap_cli.io.mounts import find_part, mounts_of
from bsmap_cli.model import Array, IntArray, LaserScans, ScanLog
from bsmap_cli.params import LogParams

logger = logging.getLogger("bsmap")

# Scans farther than this from the next odometry are counted in a warning, ns.
ODOMETRY_GAP_NS = ros.NANOSECONDS


def read_log(path: Path | str, params: LogParams | None = None) -> ScanLog:
    """Read a log; topics are found from the mounts where `params` does not name them.

    Damage costs what is damaged, not the log: it is logged as a warning with the number of messages.

    Raises
    ------
    MissingInputError
        There is no such file.
    BadInputError
        It is not an MCAP file, is empty, or lacks the horizontal laser or the odometry.
    """
    params = params or LogParams()
    topics = read_topics(path)
    mounts = mounts_of(topics)
    part = find_part(topics, mounts, "horizontal", params.horizontal_topic)
    if part is None:
        raise BadInputError(f"{path}: no horizontal laser; topics: {topics.summary()}")
    horizontal, log_time = laser_scans(topics.path, part.topic, topics.scans[part.topic], part.mount)
    odometry = _odometry_at(topics, params, horizontal.time_ns, log_time) if params.use_odometry else None
    other = find_part(topics, mounts, "vertical", params.vertical_topic)
    vertical = other and laser_scans(topics.path, other.topic, topics.scans[other.topic], other.mount)[0]
    return ScanLog(horizontal, odometry, vertical)


def _odometry_topic(topics: LogTopics, wanted: str | None) -> str:
    """Topic of the odometry: `wanted`, or the one with the most messages."""
    if wanted is not None and wanted not in topics.odometry:
        raise BadInputError(f"{topics.path}: no odometry topic {wanted}; topics: {topics.summary()}")
    if not topics.odometry:
        raise BadInputError(
            f"{topics.path}: no odometry (nav_msgs/Odometry); --no-odometry goes without; topics: {topics.summary()}"
        )
    best = wanted or max(topics.odometry, key=lambda topic: len(topics.odometry[topic].time_ns))
    if wanted is None and len(topics.odometry) > 1:
        others = ", ".join(topic for topic in topics.odometry if topic != best)
        logger.warning("%s: odometry: %s is used, not %s", topics.path, best, others)
    return best


def _odometry_at(topics: LogTopics, params: LogParams, time_ns: IntArray, log_time: IntArray) -> Array:
    """Odometry (n, 3) at the scans with these stamps and log times (n,)."""
    odometry = topics.odometry[_odometry_topic(topics, params.odometry_topic)]
    at, times = _common_clock(topics.path, odometry, time_ns, log_time)
    gap = np.maximum(times[0] - at, at - times[-1])
    if outside := int(np.count_nonzero(gap > ODOMETRY_GAP_NS)):
        logger.warning(
            "%s: %d scans lie outside the time of the odometry, up to %.1f s", topics.path, outside, gap.max() / 1e9
        )
    last = np.append(np.diff(times) > 0, True)  # of poses with one time the last one counts
    return se2.interpolate(times[last], np.array(odometry.poses)[last], at)


def _common_clock(
    path: Path, odometry: OdometryTopic, time_ns: IntArray, log_time: IntArray
) -> tuple[IntArray, IntArray]:
    """Times of scans and odometry to line them up by: the stamps, or the log times where stamps cannot serve."""
    stamps, log_times = np.array(odometry.time_ns, np.int64), np.array(odometry.log_time, np.int64)
    ordered = bool(np.all(np.diff(time_ns) >= 0) and np.all(np.diff(stamps) >= 0))
    apart = time_ns.max() < stamps.min() or time_ns.min() > stamps.max()
    if ordered and not apart:
        return time_ns, stamps
    reason = "have no time in common" if ordered else "step back in time"
    logger.warning("%s: stamps of scans and odometry %s; lined up by the time of logging", path, reason)
    return log_time, np.maximum.accumulate(log_times)


class ScanRow(NamedTuple):
    """One scan to be written: ranges (m,), nan is "no return"; `scans` gives topic, frame, angles and limits."""

    time_ns: int
    scans: LaserScans
    ranges: NDArray[np.float32]


class OdometryRow(NamedTuple):
    """One odometry pose to be written: x, y, theta of base_link in odom."""

    time_ns: int
    pose: ArrayLike


Row = ScanRow | OdometryRow


def write_scans(
    path: Path | str,
    horizontal: LaserScans,
    vertical: LaserScans | None,
    odometry_time_ns: IntArray,
    odometry_poses: Array,
    provenance: Provenance | None = None,
) -> int:
    """Write a log of whole arrays in the order of time; raises and returns as `write_log`.

    At one time odometry comes first, then the horizontal laser. Topics and frames without a name get /scan_horizontal,
    laser_horizontal, /scan_vertical and laser_vertical.
    """
    named = [_named(s, name) for s, name in ((horizontal, "horizontal"), (vertical, "vertical")) if s is not None]
    odometry = (OdometryRow(int(t), pose) for t, pose in zip(odometry_time_ns, odometry_poses, strict=True))
    streams: list[Iterator[Row]] = [odometry, *map(_scan_rows, named)]
    rows = merge(*streams, key=lambda row: row.time_ns)
    return write_log(path, rows, {scans.frame_id: scans.mount for scans in named}, provenance)


def _named(scans: LaserScans, name: str) -> LaserScans:
    return replace(scans, topic=scans.topic or f"/scan_{name}", frame_id=scans.frame_id or f"laser_{name}")


def _scan_rows(scans: LaserScans) -> Iterator[Row]:
    return (ScanRow(int(t), scans, ranges) for t, ranges in zip(scans.time_ns, scans.ranges, strict=True))


def write_log(
    path: Path | str, rows: Iterable[Row], mounts: Mapping[str, Array], provenance: Provenance | None = None
) -> int:
    """Write a log row by row; return their number.

    Scans go to their `topic`, odometry to /odom (odom -> base_link), `mounts` (frame -> T_base_laser) to /tf_static.
    The time of logging is the stamp where stamps ascend; where they step back it goes on by a nanosecond, so that
    the order of the rows is the order of the log. A scan shares it with the odometry of its stamp right before it.

    Raises
    ------
    CannotWriteError
        The file cannot be written.
    """
    count, stamp, log_time = 0, -1, -1
    with ros_writer(path, provenance) as writer:
        for row in rows:
            if row.time_ns != stamp or isinstance(row, OdometryRow):
                stamp, log_time = row.time_ns, max(row.time_ns, log_time + 1)
            if not count:
                _write_mounts(writer, mounts, stamp)
            _write_row(writer, row, log_time)
            count += 1
    return count


def _write_mounts(writer: RosWriter, mounts: Mapping[str, Array], time_ns: int) -> None:
    transforms = [ros.transform_message(T, time_ns, "base_link", frame) for frame, T in mounts.items()]
    writer.write("/tf_static", ros.tf_message(transforms), time_ns)


def _write_row(writer: RosWriter, row: Row, log_time: int) -> None:
    if isinstance(row, OdometryRow):
        writer.write("/odom", ros.odometry_message(row.time_ns, row.pose), log_time)
    else:
        writer.write(row.scans.topic, ros.scan_of(row.scans, row.time_ns, row.ranges), log_time)


@dataclass(frozen=True)
class TopicDescription:
    """A topic of a log: rate in Hz by the time of logging; part is horizontal, vertical, odometry, mounts or empty."""

    topic: str
    type_name: str
    count: int
    rate: float
    part: str


@dataclass(frozen=True)
class LogDescription:
    """What `bsmap info` says of a log: times in ns since 1970; mounts are T_base_laser by laser topic."""

    topics: tuple[TopicDescription, ...]
    start_ns: int
    end_ns: int
    mounts: dict[str, Array]


def describe_log(path: Path | str, params: LogParams | None = None) -> LogDescription:
    """Topics, counts, rates, time span and mounts of a log, and which topic plays which part.

    A part that cannot be told is a warning. Raises MissingInputError and BadInputError for what is no log at all.
    """
    params = params or LogParams()
    topics = read_topics(path)
    parts, mounts = {"/tf_static": "mounts"}, mounts_of(topics)
    try:
        for plane, wanted in (("horizontal", params.horizontal_topic), ("vertical", params.vertical_topic)):
            if found := find_part(topics, mounts, plane, wanted):
                parts[found.topic] = plane
        if topics.odometry:
            parts[_odometry_topic(topics, params.odometry_topic)] = "odometry"
    except BadInputError as error:
        logger.warning("%s", error)
    described = [_describe(topics, topic, parts.get(topic, "")) for topic in topics.log_times]
    known = {topic: mount for topic, mount in mounts.items() if mount is not None}
    times = [t for topic in topics.log_times.values() for t in topic]
    return LogDescription(tuple(described), min(times), max(times), known)


def _describe(topics: LogTopics, topic: str, part: str) -> TopicDescription:
    times = topics.log_times[topic]
    seconds = (max(times) - min(times)) / 1e9
    rate = (len(times) - 1) / seconds if seconds > 0 else 0.0
    return TopicDescription(topic, topics.types[topic], len(times), rate, part)
