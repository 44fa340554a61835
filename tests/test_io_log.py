"""Reading and writing logs: round trips, finding the parts, clocks, damage."""

import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from bsmap_cli.errors import BadInputError, CannotWriteError, MissingInputError
from bsmap_cli.io import ros
from bsmap_cli.io.artifact import Provenance, read_provenance
from bsmap_cli.io.log import OdometryRow, ScanRow, describe_log, read_log, write_log, write_scans
from bsmap_cli.io.mcap_file import read_messages, ros_writer
from bsmap_cli.model import LaserScans
from bsmap_cli.params import LogParams

START = 1_700_000_000_123_456_789
# z of the laser along the robot's y: its plane is upright.
UPRIGHT = np.array([[1.0, 0, 0, 0.1], [0, 0, -1, 0], [0, 1, 0, 0.4], [0, 0, 0, 1]])


def lasers(count: int = 40, beams: int = 30, step: int = 100_000_000) -> tuple[LaserScans, LaserScans]:
    ranges = np.random.default_rng(1).uniform(0.5, 9.0, (count, beams)).astype(np.float32)
    ranges[3, 4] = np.nan
    mount = np.eye(4)
    mount[:3, 3] = 0.2, 0.0, 0.3
    horizontal = LaserScans(
        *(START + step * np.arange(count), ranges, -1.5, 0.1, 0.0, 0.1, 30.0, mount),
    )
    vertical = replace(horizontal, time_ns=horizontal.time_ns + step // 2, mount=UPRIGHT, time_increment=2.0**-12)
    return horizontal, vertical


def odometry(count: int = 80, step: int = 50_000_000) -> tuple[Any, Any]:
    s = np.linspace(0.0, 4.0, count)
    return START + step * np.arange(count), np.column_stack([s, np.sin(s), 3.0 + s / 2])


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.mcap"
    write_scans(path, *lasers(), *odometry())
    return path


def write_topics(path: Path, topics: dict[str, tuple[str, np.ndarray | None, int]], **extra: Any) -> None:
    """Log of laser topics: topic -> (frame, mount or None, number of scans); `extra` passes odometry."""
    base = lasers()[0]
    mounts = {frame: mount for frame, mount, _ in topics.values() if mount is not None}
    rows: list[Any] = [OdometryRow(START, (0.0, 0.0, 0.0))] if extra.get("odometry", True) else []
    for topic, (frame, _, count) in topics.items():
        scans = replace(base, topic=topic, frame_id=frame)
        rows += [ScanRow(int(base.time_ns[i]), scans, base.ranges[i]) for i in range(count)]
    write_log(path, rows, mounts)


def test_log_comes_back_as_it_was_written(log: Path) -> None:
    (horizontal, vertical), poses = lasers(), odometry()[1]
    read = read_log(log)
    assert read.vertical is not None
    for one, other in ((read.horizontal, horizontal), (read.vertical, vertical)):
        np.testing.assert_array_equal(one.time_ns, other.time_ns)
        np.testing.assert_array_equal(one.ranges, other.ranges)
        np.testing.assert_allclose(one.mount, other.mount, atol=1e-15)
        np.testing.assert_allclose(one.angles, other.angles, atol=1e-6)
        assert one.time_increment == other.time_increment
    assert (read.horizontal.topic, read.horizontal.frame_id) == ("/scan_horizontal", "laser_horizontal")
    assert read.odometry is not None
    np.testing.assert_allclose(read.odometry[:, :2], poses[::2, :2], atol=1e-12)
    np.testing.assert_allclose(np.exp(1j * read.odometry[:, 2]), np.exp(1j * poses[::2, 2]), atol=1e-12)


def test_messages_are_those_of_the_mcap_packages_reader(log: Path) -> None:
    with open(log, "rb") as file:
        theirs = [(c.topic, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages(log_time_order=False)]
    assert [(m.topic, m.log_time, m.data) for m in read_messages(log)] == theirs


def test_same_log_same_bytes_and_provenance_in_front(tmp_path: Path) -> None:
    made = Provenance("simulate", "0.1.0", {"seed": 1}, (), "a" * 56, {"scans": 40})
    for name in ("a.mcap", "b.mcap"):
        write_scans(tmp_path / name, *lasers(), *odometry(), provenance=made)
    content = (tmp_path / "a.mcap").read_bytes()
    assert content == (tmp_path / "b.mcap").read_bytes()
    assert b"bsmap-fingerprint:" + b"a" * 56 in content[:300]
    assert read_provenance(tmp_path / "a.mcap") == made


def test_without_vertical_laser_and_without_odometry(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_topics(path, {"/scan": ("laser", np.eye(4), 5)}, odometry=False)
    assert read_log(path, LogParams(use_odometry=False)).vertical is None
    with pytest.raises(BadInputError, match=r"no odometry .*--no-odometry.*/scan \(sensor_msgs/msg/LaserScan, 5\)"):
        read_log(path)


def test_invalid_ranges_are_no_return(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    scans = replace(lasers()[0], topic="/s", frame_id="laser", range_min=0.5, range_max=10.0)
    row = np.array([0.5, 0.49, 10.0, 10.01, np.nan, np.inf, -np.inf, -1.0, 0.0], np.float32)
    write_log(path, [OdometryRow(START, (0, 0, 0)), ScanRow(START, scans, row)], {"laser": np.eye(4)})
    np.testing.assert_array_equal(np.isfinite(read_log(path).horizontal.ranges[0]), [1, 0, 0, 0, 0, 0, 0, 0, 0])


def test_zero_is_no_return_even_where_the_limits_allow_it(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    scans = replace(lasers()[0], topic="/s", frame_id="laser", range_min=0.0, range_max=10.0)
    row = np.array([0.0, 1e-3, 9.99], np.float32)
    write_log(path, [OdometryRow(START, (0, 0, 0)), ScanRow(START, scans, row)], {"laser": np.eye(4)})
    np.testing.assert_array_equal(np.isfinite(read_log(path).horizontal.ranges[0]), [0, 1, 1])


def test_scans_of_other_angles_are_dropped_and_short_ones_padded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "log.mcap"
    base = replace(lasers()[0], topic="/s", frame_id="laser")
    odd = replace(base, angle_increment=0.2)
    rows = [ScanRow(START + i, odd if i == 2 else base, base.ranges[0, : 20 + i]) for i in range(4)]
    write_log(path, [OdometryRow(START, (0, 0, 0)), *rows], {"laser": np.eye(4)})
    scans = read_log(path).horizontal
    assert scans.ranges.shape == (3, 23)
    np.testing.assert_array_equal(np.isnan(scans.ranges[:, 20:]).sum(axis=1), [3, 2, 0])
    assert "1 of 4 scans dropped" in caplog.text


def test_laser_that_looks_ahead_is_preferred(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "log.mcap"
    write_topics(path, {"/rear": ("rear", np.diag([-1.0, -1, 1, 1]), 9), "/front": ("front", np.eye(4), 5)})
    assert read_log(path).horizontal.topic == "/front"
    assert "horizontal laser: /front is used, not /rear" in caplog.text
    assert read_log(path, LogParams(horizontal_topic="/rear")).horizontal.topic == "/rear"
    with pytest.raises(BadInputError, match=r"no laser topic /none; topics: .*/rear"):
        read_log(path, LogParams(horizontal_topic="/none"))


def test_only_laser_without_mount_is_horizontal(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "log.mcap"
    write_topics(path, {"/scan": ("laser", None, 5)})
    np.testing.assert_array_equal(read_log(path).horizontal.mount, np.eye(4))
    assert "nothing is known of the mount of /scan (laser); identity is used" in caplog.text


def test_two_lasers_without_mounts_are_refused_unless_named(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_topics(path, {"/a": ("one", None, 5), "/b": ("two", UPRIGHT, 5), "/c": ("three", None, 5)})
    with pytest.raises(BadInputError, match=r"no transform to base_link on /tf_static for /a \(one\), /c \(three\)"):
        read_log(path)
    assert {topic.topic for topic in describe_log(path).topics} == {"/tf_static", "/odom", "/a", "/b", "/c"}
    assert read_log(path, LogParams(horizontal_topic="/a")).vertical is not None
    with pytest.raises(BadInputError, match=r"/c: /tf_static has no transform from three to base_link"):
        read_log(path, LogParams(horizontal_topic="/a", vertical_topic="/c"))


def test_log_with_only_a_vertical_laser_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    write_topics(path, {"/b": ("two", UPRIGHT, 5)})
    with pytest.raises(BadInputError, match=r"no horizontal laser; topics: /tf_static .*, /b \(sensor_msgs"):
        read_log(path)


def test_mount_is_a_chain_of_transforms_with_leading_slashes(tmp_path: Path) -> None:
    path, tilt = tmp_path / "log.mcap", UPRIGHT.copy()
    scan = ros.scan_of(replace(lasers()[0], frame_id="/laser"), START, lasers()[0].ranges[0])
    plate = np.eye(4)
    plate[:3, 3] = 1.0, 2.0, 3.0
    with ros_writer(path) as writer:
        chain = [("/base_link", "/plate", plate), ("plate", "/laser", tilt), ("base_footprint", "base_link", plate)]
        writer.write("/tf_static", ros.tf_message([ros.transform_message(T, 0, a, b) for a, b, T in chain]), 0)
        writer.write("/scan", scan, 1)
        writer.write("/odom", ros.odometry_message(START, (0, 0, 0)), 2)
    np.testing.assert_allclose(describe_log(path).mounts["/scan"], plate @ tilt, atol=1e-15)


def test_stamps_that_step_back_are_lined_up_by_order(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, base = tmp_path / "log.mcap", replace(lasers()[0], topic="/s", frame_id="laser")
    stamps = START + np.array([0, 10, 5, 20, 3]) * 100_000_000
    rows: list[Any] = []
    for i, stamp in enumerate(stamps.tolist()):
        rows += [OdometryRow(stamp, (float(i), 0.0, 0.0)), ScanRow(stamp, base, base.ranges[i])]
    write_log(path, rows, {"laser": np.eye(4)})
    read = read_log(path)
    np.testing.assert_array_equal(read.horizontal.time_ns, stamps)
    np.testing.assert_array_equal(read.horizontal.ranges, base.ranges[:5])
    assert read.odometry is not None
    np.testing.assert_array_equal(read.odometry[:, 0], np.arange(5.0))
    assert "step back in time; lined up by the time of logging" in caplog.text


def test_scans_far_outside_the_odometry_are_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    times, poses = odometry(20)
    write_scans(tmp_path / "log.mcap", *lasers(), times, poses)
    read = read_log(tmp_path / "log.mcap")
    assert "20 scans lie outside the time of the odometry, up to 3.0 s" in caplog.text
    assert read.odometry is not None
    np.testing.assert_allclose(read.odometry[-1, :2], poses[-1, :2])


def test_of_odometry_with_one_stamp_the_last_counts(tmp_path: Path) -> None:
    path, base = tmp_path / "log.mcap", replace(lasers()[0], topic="/s", frame_id="laser")
    rows: list[Any] = [OdometryRow(START + t, (x, 0.0, 3.0)) for t, x in ((0, 0.0), (10, 1.0), (10, 7.0), (20, 9.0))]
    write_log(path, [*rows, *(ScanRow(START + t, base, base.ranges[0]) for t in (10, 20))], {"laser": np.eye(4)})
    odometry_at_scans = read_log(path).odometry
    assert odometry_at_scans is not None
    np.testing.assert_array_equal(odometry_at_scans[:, 0], [7.0, 9.0])


def test_description_names_the_parts(log: Path) -> None:
    described = describe_log(log)
    parts = {topic.topic: (topic.part, topic.count, round(topic.rate)) for topic in described.topics}
    assert parts["/scan_horizontal"] == ("horizontal", 40, 10)
    assert parts["/scan_vertical"] == ("vertical", 40, 10)
    assert parts["/odom"] == ("odometry", 80, 20)
    assert parts["/tf_static"][0] == "mounts"
    assert (described.start_ns, described.end_ns) == (START, START + 80 * 50_000_000 - 50_000_000)
    np.testing.assert_allclose(described.mounts["/scan_vertical"], UPRIGHT, atol=1e-15)


def big_log(path: Path) -> bytes:
    """A log of several chunks."""
    write_scans(path, *lasers(600, 700), *odometry(600))
    return path.read_bytes()


def test_cut_log_gives_what_was_saved(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "log.mcap"
    content = big_log(path)
    path.write_bytes(content[: len(content) * 2 // 3])
    scans = read_log(path).horizontal
    assert 250 < len(scans.time_ns) < 420
    assert f"{path}: was cut; the " in caplog.text
    for size in range(len(content) - 400, len(content), 37):
        path.write_bytes(content[:size])
        assert len(read_log(path).horizontal.time_ns) == 600


def test_damaged_chunk_is_found_by_its_crc_and_skipped(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "log.mcap"
    content = bytearray(big_log(path))
    content[len(content) // 2] ^= 0xFF
    path.write_bytes(content)
    assert 450 < len(read_log(path).horizontal.time_ns) < 600
    assert "is damaged" in caplog.text
    assert "messages that could be read are used" in caplog.text


def test_crc_alone_finds_damage_that_decodes(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "log.mcap"
    with open(path, "wb") as file:
        writer = Writer(file, 20_000, compression=CompressionType.NONE)
        writer.start("ros2")
        schema = writer.register_schema(ros.ODOMETRY, "ros2msg", ros.schema_text(ros.ODOMETRY))
        channel = writer.register_channel("/odom", "cdr", schema)
        for i in range(100):
            data = ros.encode(ros.odometry_message(START + i, (1.0, 2.0, 0.0)))
            writer.add_message(channel, i, data, i)
        writer.finish()
    content = bytearray(path.read_bytes())
    where = content.index(np.float64(2.0).tobytes(), len(content) // 2)
    content[where + 6] ^= 0x01
    path.write_bytes(content)
    counts = {topic.topic: topic.count for topic in describe_log(path).topics}
    assert 50 < counts["/odom"] < 100
    assert "crc validation failed in Chunk" in caplog.text


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is empty"),
        (b"\x89MCAP0\r\n", "was cut; nothing in it can be used"),
        (b"#ROSBAG V2.0\n", r"bags are not read; convert it to MCAP"),
        (b"SQLite format 3\0", "bags are not read"),
        (b"FLASER 1 2 3", r"is not an MCAP file \(CARMEN logs: `bsmap import`"),
    ],
)
def test_what_is_no_log_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(BadInputError, match=message):
        read_log(path)


def test_missing_log_and_log_without_messages(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"none\.mcap: No such file"):
        read_log(tmp_path / "none.mcap")
    with ros_writer(tmp_path / "a.mcap"):
        pass
    with pytest.raises(BadInputError, match="holds no messages"):
        read_log(tmp_path / "a.mcap")


def test_undecodable_messages_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "log.mcap"
    write_topics(path, {"/scan": ("laser", np.eye(4), 5)})
    with open(path, "wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        schema = writer.register_schema(ros.LASER_SCAN, "ros2msg", ros.schema_text(ros.LASER_SCAN))
        channel = writer.register_channel("/scan", "cdr", schema)
        scans = lasers()[0]
        data = ros.encode(ros.scan_of(scans, START, scans.ranges[0]))
        for size in (len(data), 40, 3):
            writer.add_message(channel, 0, data[:size], 0)
        writer.finish()
    with caplog.at_level(logging.WARNING):
        read = read_log(path, LogParams(use_odometry=False))
    assert len(read.horizontal.time_ns) == 1
    assert "2 messages could not be decoded, first /scan" in caplog.text


def test_log_into_a_missing_directory_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CannotWriteError, match="cannot be written: No such file or directory"):
        write_scans(tmp_path / "none" / "log.mcap", *lasers(), *odometry())


def test_quaternions_and_matrices_agree() -> None:
    from scipy.spatial.transform import Rotation

    for R in Rotation.random(50, random_state=1):
        q = ros.quaternion_from_matrix(R.as_matrix())
        np.testing.assert_allclose(q, R.as_quat(canonical=True), atol=1e-14)
        np.testing.assert_allclose(ros.matrix_from_quaternion(2 * q), R.as_matrix(), atol=1e-14)
