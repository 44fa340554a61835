"""Where the lasers sit on the robot, and so which one looks along the ground and which one across it."""

import logging
from typing import NamedTuple

import numpy as np

from bsmap_cli.errors import BadInputError
from bsmap_cli.io.log_topics import LogTopics
from bsmap_cli.model import Array

logger = logging.getLogger("bsmap")

# A scan plane within 20 degrees of the ground's, or of the vertical, counts as parallel, or perpendicular, to it.
PLANE_TOLERANCE = np.radians(20.0)


class Part(NamedTuple):
    """Laser topic that plays a part, and its mount (4, 4), T_base_laser."""

    topic: str
    mount: Array


def mount_of(topics: LogTopics, frame_id: str) -> Array | None:
    """T_base_laser of a frame: the chain of transforms up to base_link, or base_footprint, or the top of the tree.

    Transforms of /tf count where /tf_static has none. None where nothing is known of the frame.
    """
    tree = topics.moving | topics.transforms
    T, frame, seen = np.eye(4), frame_id, {frame_id}
    while frame in tree and frame != "base_link":
        parent, matrix = tree[frame]
        if parent in seen or frame == "base_footprint":
            break
        T, frame = matrix @ T, parent
        seen.add(frame)
    if frame in ("base_link", "base_footprint"):
        return T
    if frame == frame_id:
        return None
    logger.warning("%s: %s has no chain to base_link; its mount is taken from %s", topics.path, frame_id, frame)
    return T


def plane_of(mount: Array) -> str:
    """`horizontal`, `vertical` or `tilted`: the scan plane of a laser with this mount (4, 4)."""
    tilt = np.arccos(np.clip(abs(mount[2, 2]), 0.0, 1.0))
    if tilt <= PLANE_TOLERANCE:
        return "horizontal"
    return "vertical" if tilt >= np.pi / 2 - PLANE_TOLERANCE else "tilted"


def mounts_of(topics: LogTopics) -> dict[str, Array | None]:
    """Mount of every laser topic, None where nothing is known of it."""
    return {topic: mount_of(topics, scans.frame_id) for topic, scans in topics.scans.items()}


def find_part(topics: LogTopics, mounts: dict[str, Array | None], plane: str, wanted: str | None) -> Part | None:
    """Laser that plays the part `plane` (horizontal or vertical): the topic `wanted`, or the one whose mount fits.

    Of several the one that looks ahead, then the one with the most scans is taken, with a warning. A log's only laser
    counts as horizontal, at the robot's centre, where nothing is known of its mount.

    Raises
    ------
    BadInputError
        There is no laser topic `wanted`, or lasers have no mounts.
    """
    if wanted is not None:
        return _wanted_part(topics, plane, wanted, mounts)
    fitting = [Part(t, mount) for t, mount in mounts.items() if mount is not None and plane_of(mount) == plane]
    if not fitting:
        return _unmounted_part(topics, plane, mounts)
    best = max(fitting, key=lambda part: (_looks_ahead(topics, part), len(topics.scans[part.topic].time_ns)))
    if len(fitting) > 1:
        others = ", ".join(part.topic for part in fitting if part is not best)
        logger.warning("%s: %s laser: %s is used, not %s", topics.path, plane, best.topic, others)
    return best


def _wanted_part(topics: LogTopics, plane: str, wanted: str, mounts: dict[str, Array | None]) -> Part:
    if wanted not in mounts:
        raise BadInputError(f"{topics.path}: no laser topic {wanted}; topics: {topics.summary()}")
    mount = mounts[wanted]
    if mount is None and plane == "vertical":
        raise BadInputError(
            f"{topics.path}: {wanted}: /tf_static has no transform from {topics.scans[wanted].frame_id} to base_link"
        )
    if mount is None:
        return Part(wanted, _assumed_mount(topics, wanted))
    if plane_of(mount) != plane:
        logger.warning("%s: %s is used as %s laser, but its mount is %s", topics.path, wanted, plane, plane_of(mount))
    return Part(wanted, mount)


def _unmounted_part(topics: LogTopics, plane: str, mounts: dict[str, Array | None]) -> Part | None:
    unknown = [topic for topic, mount in mounts.items() if mount is None]
    if plane == "horizontal" and len(mounts) == 1 and unknown:
        return Part(unknown[0], _assumed_mount(topics, unknown[0]))
    if plane == "horizontal" and unknown:
        frames = ", ".join(f"{topic} ({topics.scans[topic].frame_id})" for topic in unknown)
        raise BadInputError(
            f"{topics.path}: no transform to base_link on /tf_static for {frames}; "
            "name the horizontal laser's topic (--horizontal-topic) to take it as mounted at the robot's centre"
        )
    return None


def _assumed_mount(topics: LogTopics, topic: str) -> Array:
    frame = topics.scans[topic].frame_id
    logger.warning("%s: nothing is known of the mount of %s (%s); identity is used", topics.path, topic, frame)
    return np.eye(4)


def _looks_ahead(topics: LogTopics, part: Part) -> bool:
    """Whether the middle beam of a laser points forward."""
    scans = topics.scans[part.topic]
    angle_min, angle_increment, *_ = scans.geometry[0]
    middle = angle_min + angle_increment * (len(scans.ranges[0]) - 1) / 2
    return bool(part.mount[0, :2] @ (np.cos(middle), np.sin(middle)) > 0)
