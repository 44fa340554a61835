"""CARMEN logs (.log, .clf, plain or gzip) as rows of a log.

Lines that are read, in their order; all others are passed over:

    PARAM name value ...
    ODOM x y theta tv rv accel ipc_time host logger_time
    FLASER | RLASER n r1 .. rn  laser_x laser_y laser_theta  robot_x robot_y robot_theta  ipc_time host logger_time
    ROBOTLASER1 | ROBOTLASER2 type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode
        n r1 .. rn  m s1 .. sm  laser pose  robot pose  tv rv forward_safety side_safety turn_axis  ipc_time ...

FLASER and ROBOTLASER1 are the front laser, RLASER and ROBOTLASER2 the one that looks back. Stamps are ipc_time.
"""

import gzip
import logging
import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.log import OdometryRow, Row, ScanRow
from bsmap_cli.model import Array, LaserScans

logger = logging.getLogger("bsmap")

# Readings from here on are "no return", whatever the log calls its maximum: SICK's codes for it are 81.83 and above,
# and half of that in the finer mode.
NO_RETURN = 50.0
# Laser poses that stray less than this from one mount (metres, radians) are that mount, printed with few digits.
OFFSET_SPREAD = 2e-3
_LASERS = {"FLASER": "front", "ROBOTLASER1": "front", "RLASER": "rear", "ROBOTLASER2": "rear"}
_NAMES = {"front": ("/scan_horizontal", "laser_horizontal"), "rear": ("/scan_rear", "laser_rear")}


class CarmenLog(NamedTuple):
    """A log's rows in the order of its lines, and mounts (frame -> T_base_laser), for `write_log`."""

    rows: list[Row]
    mounts: dict[str, Array]


class Geometry(NamedTuple):
    """What a scan's line says of its beams: radians, metres."""

    beams: int
    angle_min: float
    angle_increment: float
    range_max: float


class _Scan(NamedTuple):
    keyword: str
    time_ns: int
    geometry: Geometry
    ranges: list[float]
    laser_pose: Sequence[float]
    robot_pose: Sequence[float]

    @property
    def laser(self) -> str:
        return _LASERS[self.keyword]


class _Odometry(NamedTuple):
    time_ns: int
    pose: Sequence[float]


@dataclass
class _Lines:
    """What the lines said, in their order."""

    entries: list[_Scan | _Odometry] = field(default_factory=list)
    params: dict[str, str] = field(default_factory=dict)
    damaged: list[int] = field(default_factory=list)


def import_carmen(path: Path | str) -> CarmenLog:
    """Read a CARMEN log. Damaged lines are passed over, with a warning that counts them and names the first.

    Raises
    ------
    MissingInputError
        There is no such file.
    BadInputError
        There is not one laser scan in it.
    """
    lines = _Lines()
    for number, line in _numbered_lines(Path(path)):
        words = line.split()
        try:
            _take(lines, words)
        except (ValueError, IndexError, InvalidOperation):
            lines.damaged.append(number)
    if lines.damaged:
        logger.warning("%s: %d damaged lines passed over, first line %d", path, len(lines.damaged), lines.damaged[0])
    scans = [entry for entry in lines.entries if isinstance(entry, _Scan)]
    if not scans:
        raise BadInputError(f"{path}: no laser scans (FLASER, RLASER, ROBOTLASER1/2); is it a CARMEN log?")
    mounts = {laser: _mount(laser, scans, lines.params) for laser in _NAMES if any(s.laser == laser for s in scans)}
    return CarmenLog(_rows(lines.entries, mounts), {_NAMES[laser][1]: mount for laser, mount in mounts.items()})


def _numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Lines with their numbers from 1, unpacked where the content is gzip; a cut gzip file ends with a warning."""
    number = 0
    try:
        with open(path, "rb") as start:
            opener: Callable[..., IO[bytes]] = gzip.open if start.read(2) == b"\x1f\x8b" else open  # type: ignore[assignment]
        with opener(path, "rb") as file:
            for number, line in enumerate(file, 1):
                yield number, line.decode("utf-8", errors="replace")
    except (EOFError, gzip.BadGzipFile, zlib.error) as error:
        logger.warning("%s: is damaged or was cut (%s); the first %d lines are used", path, error, number)
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error


def _take(lines: _Lines, words: list[str]) -> None:
    """Take one line; ValueError, IndexError or InvalidOperation where it is damaged."""
    kind = words[0] if words else ""
    if kind == "PARAM":
        lines.params[words[1]] = words[2]
    elif kind == "ODOM":
        lines.entries.append(_Odometry(_nanoseconds(words[7]), _finite(words[1:4], 3)))
    elif kind in ("FLASER", "RLASER"):
        lines.entries.append(_parse_flaser(words, lines.params))
    elif kind in ("ROBOTLASER1", "ROBOTLASER2"):
        lines.entries.append(_parse_robotlaser(words))


def _parse_flaser(words: list[str], params: dict[str, str]) -> _Scan:
    laser, n = _LASERS[words[0]], int(words[1])
    ranges, poses = list(map(float, words[2 : 2 + n])), _finite(words[2 + n : 8 + n], 6)
    told = float(params.get(f"robot_{laser}_laser_max", "inf"))
    increment = _increment(n, float(params.get(f"laser_{laser}_laser_resolution", "0")))
    # An even number of beams lacks the one at the end: 180 beams go from -90 to 89 degrees.
    geometry = Geometry(n, -increment * (n // 2), increment, min(told, NO_RETURN))
    return _Scan(words[0], _nanoseconds(words[8 + n]), geometry, ranges, poses[:3], poses[3:])


def _increment(n: int, resolution: float) -> float:
    """Step between beams, radians: 180 degrees in all, unless the log tells another resolution (degrees)."""
    if n < 2:
        raise ValueError("fewer than two beams")
    usual = math.pi / (n if n % 2 == 0 else n - 1)
    return usual if n in (180, 181, 360, 361) or resolution <= 0 else math.radians(resolution)


def _parse_robotlaser(words: list[str]) -> _Scan:
    start, field_of_view, resolution, maximum = _finite(words[2:6], 4)
    n = int(words[8])
    if n < 2:
        raise ValueError("fewer than two beams")
    ranges = list(map(float, words[9 : 9 + n]))
    after = 10 + n + int(words[9 + n])
    poses = _finite(words[after : after + 6], 6)
    increment = resolution if resolution > 0 else field_of_view / (n - 1)
    geometry = Geometry(n, start, increment, min(maximum if maximum > 0 else math.inf, NO_RETURN))
    return _Scan(words[0], _nanoseconds(words[after + 11]), geometry, ranges, poses[:3], poses[3:])


def _nanoseconds(seconds: str) -> int:
    """Exact integer nanoseconds of a decimal number of seconds."""
    return round(Decimal(seconds) * 1_000_000_000)


def _finite(words: list[str], count: int) -> list[float]:
    numbers = list(map(float, words))
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError("missing or not a number")
    return numbers


def _mount(laser: str, scans: list[_Scan], params: dict[str, str]) -> Array:
    """T_base_laser: by the log's parameters, or by laser and robot pose of the scans where these always agree.

    The rear laser of RLASER looks back; many logs give it the robot's theta all the same.
    """
    here = [scan for scan in scans if scan.laser == laser]
    x = float(params.get(f"robot_{laser}laser_offset", "0"))
    y = float(params.get(f"robot_{laser}laser_side_offset", "0"))
    theta = 0.0
    offsets = np.array([_relative(scan.robot_pose, scan.laser_pose) for scan in here])
    deviations = offsets - offsets[0]
    deviations[:, 2] = (deviations[:, 2] + np.pi) % (2 * np.pi) - np.pi
    if np.abs(deviations).max() < OFFSET_SPREAD:
        middle = offsets[0] + np.median(deviations, axis=0)
        x, y = (x, y) if x or y else middle[:2]
        theta = middle[2]
    if here[0].keyword == "RLASER" and abs(theta) < OFFSET_SPREAD:
        theta = math.pi
    mount = np.eye(4)
    mount[:2, :2] = [[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]]
    mount[:2, 3] = x, y
    return mount


def _relative(first: Sequence[float], second: Sequence[float]) -> tuple[float, float, float]:
    """Pose of `second` in the frame of `first`; both x, y, theta."""
    dx, dy = second[0] - first[0], second[1] - first[1]
    c, s = math.cos(first[2]), math.sin(first[2])
    return c * dx + s * dy, c * dy - s * dx, second[2] - first[2]


def _rows(entries: list[_Scan | _Odometry], mounts: dict[str, Array]) -> list[Row]:
    """Rows of all entries; a scan's robot pose is an odometry row right before the scan, with its stamp."""
    rows: list[Row] = []
    lasers: dict[tuple[str, Geometry], LaserScans] = {}
    for entry in entries:
        if isinstance(entry, _Odometry):
            rows.append(OdometryRow(entry.time_ns, entry.pose))
            continue
        key = entry.laser, entry.geometry
        if key not in lasers:
            lasers[key] = _laser(entry, mounts[entry.laser])
        ranges = np.array(entry.ranges, dtype=np.float32)
        ranges[~(ranges < entry.geometry.range_max)] = np.nan
        rows += [OdometryRow(entry.time_ns, entry.robot_pose), ScanRow(entry.time_ns, lasers[key], ranges)]
    return rows


def _laser(scan: _Scan, mount: Array) -> LaserScans:
    """The laser that took a scan: angles, limits, names, and no scans."""
    topic, frame_id = _NAMES[scan.laser]
    return LaserScans(
        time_ns=np.zeros(0, np.int64),
        ranges=np.zeros((0, scan.geometry.beams), np.float32),
        angle_min=scan.geometry.angle_min,
        angle_increment=scan.geometry.angle_increment,
        time_increment=0.0,
        range_min=0.0,
        range_max=scan.geometry.range_max,
        mount=mount,
        frame_id=frame_id,
        topic=topic,
    )
