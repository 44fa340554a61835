"""The artifact of `slam`: to the last bit and back, the messages viewers want, refusals."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bsmap_cli.errors import BadInputError
from bsmap_cli.io import ros
from bsmap_cli.io.artifact import Provenance, read_provenance
from bsmap_cli.io.completeness import is_complete
from bsmap_cli.io.mcap_file import read_messages, ros_writer
from bsmap_cli.io.slam_mcap import read_slam, write_slam
from bsmap_cli.model import LaserScans, LineMap, LoopClosures, SlamMap, StepStatistics, Trajectory, no_closures

START = 1_700_000_000_123_456_789


def symmetric(rng: np.random.Generator, count: int, size: int) -> np.ndarray:
    half = rng.normal(size=(count, size, size))
    return half @ half.swapaxes(1, 2)


def slam_map(n: int = 25, m: int = 6, beams: int = 40) -> SlamMap:
    rng = np.random.default_rng(3)
    times = START + 100_000_000 * np.arange(n)
    ranges = rng.uniform(0.5, 9.0, (n - 1, beams)).astype(np.float32)
    ranges[rng.uniform(size=ranges.shape) < 0.1] = np.nan
    mount = np.array([[1.0, 0, 0, 0.1], [0, 0, -1, 0], [0, 1, 0, 1 / 3], [0, 0, 0, 1]])
    counts = rng.integers(0, 20, (4, n))
    return SlamMap(
        Trajectory(times, rng.normal(size=(n, 3)) * 5, symmetric(rng, n, 3), rng.normal(size=(n, 3, 4))),
        LineMap(
            rng.uniform(0, 3, (m, 2)), symmetric(rng, m, 2), np.sort(rng.normal(size=(m, 2))),
            rng.choice([-1, 1], m), rng.integers(1, 99, m),
        ),
        StepStatistics(counts[0], counts[1], counts[2], rng.chisquare(3, n), counts[3]),
        LaserScans(times[1:] - 7, ranges, -2.3, 1 / 3, 1e-5, 0.1, 30.0, mount, "laser_vertical", "/scan_vertical"),
        np.eye(4),
        closures=LoopClosures(
            np.array([0, 3, 1]), np.array([20, 21, 24]), rng.normal(size=(3, 3)), np.array([True, False, True])
        ),
        tracked_poses=rng.normal(size=(n, 3)) * 5,
    )  # fmt: skip


def assert_same(one: Any, other: Any) -> None:
    """Equal to the last bit, field by field."""
    if hasattr(one, "__dataclass_fields__"):
        for field in fields(one):
            assert_same(getattr(one, field.name), getattr(other, field.name))
    elif isinstance(one, np.ndarray):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)
    else:
        assert one == other


def test_slam_map_comes_back_to_the_last_bit(tmp_path: Path) -> None:
    slam = slam_map()
    write_slam(tmp_path / "a.slam.mcap", slam)
    assert_same(read_slam(tmp_path / "a.slam.mcap"), slam)


def test_slam_map_without_vertical_laser_and_lines(tmp_path: Path) -> None:
    slam = replace(slam_map(m=0), vertical=None, closures=no_closures(), tracked_poses=None)
    write_slam(tmp_path / "a.slam.mcap", slam)
    assert_same(read_slam(tmp_path / "a.slam.mcap"), slam)


def test_stamps_that_step_back_come_back_in_order(tmp_path: Path) -> None:
    slam = slam_map()
    times = slam.trajectory.time_ns.copy()
    times[[4, 9]] = times[[9, 4]]
    slam = replace(slam, trajectory=replace(slam.trajectory, time_ns=times))
    write_slam(tmp_path / "a.slam.mcap", slam)
    assert_same(read_slam(tmp_path / "a.slam.mcap"), slam)
    log_times = [message.log_time for message in read_messages(tmp_path / "a.slam.mcap")]
    assert log_times == sorted(log_times)


def test_same_map_same_bytes_and_provenance(tmp_path: Path) -> None:
    made = Provenance("slam", "0.1.0", {}, (("log.mcap", "0" * 64),), "b" * 56, {"poses": 25})
    for name in "ab":
        write_slam(tmp_path / name, slam_map(), made)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    assert read_provenance(tmp_path / "a") == made


def test_viewers_find_standard_messages(tmp_path: Path) -> None:
    slam = slam_map()
    write_slam(tmp_path / "a.slam.mcap", slam)
    messages: dict[str, list[Any]] = {}
    for message in read_messages(tmp_path / "a.slam.mcap"):
        messages.setdefault(message.topic, []).append(ros.decode(message.data, message.type_name))
    counts = {topic: len(values) for topic, values in messages.items()}
    assert counts == {
        "/tf_static": 1, "/bsmap/slam": 1, "/map/segments": 1, "/map/closures": 1,
        "/trajectory": 1, "/trajectory_tracked": 1, "/bsmap/tracked": 1, "/bsmap/modes": 1,
        "/pose": 25, "/tf": 25, "/bsmap/steps": 25, "/scan_vertical": 24,
    }  # fmt: skip
    assert {t.child_frame_id for t in messages["/tf_static"][0].transforms} == {"laser_horizontal", "laser_vertical"}
    transform = messages["/tf"][3].transforms[0]
    assert (transform.header.frame_id, transform.child_frame_id) == ("map", "base_link")
    c, s = np.cos(slam.trajectory.poses[3, 2]), np.sin(slam.trajectory.poses[3, 2])
    np.testing.assert_allclose(ros.matrix_of(transform.transform)[:2, :2], [[c, -s], [s, c]], atol=1e-15)
    np.testing.assert_allclose(
        ros.planar_pose(messages["/trajectory"][0].poses[3].pose)[:2], slam.trajectory.poses[3, :2]
    )
    points = np.array([(p.x, p.y) for p in messages["/map/segments"][0].markers[0].points])
    alpha, r = np.repeat(slam.lines.parameters, 2, axis=0).T
    np.testing.assert_allclose(points[:, 0] * np.cos(alpha) + points[:, 1] * np.sin(alpha), r, atol=1e-14)
    np.testing.assert_allclose(points[:, 1] * np.cos(alpha) - points[:, 0] * np.sin(alpha), slam.lines.extents.ravel())


def test_viewers_are_shown_the_loops_and_the_way_before_they_were_closed(tmp_path: Path) -> None:
    slam = slam_map()
    write_slam(tmp_path / "a.slam.mcap", slam)
    decoded = {m.topic: ros.decode(m.data, m.type_name) for m in read_messages(tmp_path / "a.slam.mcap")}
    marker = decoded["/map/closures"].markers[0]
    assert marker.type == 5  # LINE_LIST
    ends = np.array([(p.x, p.y) for p in marker.points]).reshape(-1, 2, 2)
    np.testing.assert_array_equal(ends[:, 0], slam.trajectory.poses[slam.closures.first, :2])
    np.testing.assert_array_equal(ends[:, 1], slam.trajectory.poses[slam.closures.second, :2])
    assert [c.g > c.r for c in marker.colors[::2]] == slam.closures.held.tolist()
    before = [ros.planar_pose(p.pose)[:2] for p in decoded["/trajectory_tracked"].poses]
    np.testing.assert_allclose(before, slam.tracked_poses[:, :2])


def test_without_lines_and_loops_viewers_get_no_empty_marker(tmp_path: Path) -> None:
    write_slam(tmp_path / "a.slam.mcap", replace(slam_map(m=0), closures=no_closures()))
    decoded = {m.topic: ros.decode(m.data, m.type_name) for m in read_messages(tmp_path / "a.slam.mcap")}
    assert decoded["/map/segments"].markers == decoded["/map/closures"].markers == []


def test_cut_artifact_is_refused_not_used_in_part(tmp_path: Path) -> None:
    path = tmp_path / "a.slam.mcap"
    write_slam(path, slam_map(900))
    content = path.read_bytes()
    assert is_complete(path)
    for size in (len(content) - 1, len(content) - 300, len(content) // 2):
        path.write_bytes(content[:size])
        assert not is_complete(path)
        with pytest.raises(BadInputError, match=r"a\.slam\.mcap: (was cut|is damaged).*; make it again"):
            read_slam(path)
    broken = bytearray(content)
    broken[len(content) // 3] ^= 1
    path.write_bytes(broken)
    with pytest.raises(BadInputError, match=r"is damaged .*; make it again"):
        read_slam(path)


def test_a_log_is_not_a_slam_map(tmp_path: Path) -> None:
    with ros_writer(tmp_path / "log.mcap") as writer:
        writer.write("/odom", ros.odometry_message(START, (0, 0, 0)), START)
    with pytest.raises(BadInputError, match=r"is not an artifact of `bsmap slam`.*Run `bsmap slam` on it first"):
        read_slam(tmp_path / "log.mcap")


def test_another_version_is_refused(tmp_path: Path) -> None:
    with ros_writer(tmp_path / "a.mcap") as writer:
        writer.write("/bsmap/slam", ros.make("std_msgs/msg/String", data='{"format":"bsmap-slam","version":99}'), 0)
    with pytest.raises(BadInputError, match="is of version 99, this bsmap reads 3"):
        read_slam(tmp_path / "a.mcap")
