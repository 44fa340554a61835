"""CARMEN logs: every kind of line, damage, real logs."""

import gzip
import math
from pathlib import Path

import numpy as np
import pytest

from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.carmen import import_carmen
from bsmap_cli.io.log import OdometryRow, ScanRow, describe_log, read_log, write_log
from bsmap_cli.model import ScanLog

LOGS = Path(__file__).resolve().parents[2] / "shared" / "data" / "logs"
ODOM = "ODOM 1.5 2.5 0.5 0 0 0 100.000000001 host 0.1"


def flaser(n: int = 180, keyword: str = "FLASER", time: str = "100.5", x: float = 0.0, first: float = 3.0) -> str:
    ranges = " ".join(["81.83", f"{first}", *["2.5"] * (n - 2)])
    return f"{keyword} {n} {ranges} {1 + x} 2.0 0.0 1.0 2.0 0.0 {time} host 0.2"


def robotlaser(keyword: str, theta: float) -> str:
    ranges = "1.0 2.0 30.0 59.0"
    return f"{keyword} 0 -2.0 4.0 1.0 60.0 0.01 0 4 {ranges} 2 7 8 1.2 2.0 {theta} 1.0 2.0 0.0 0 0 0 0 0 101.5 host 1"


def imported(tmp_path: Path, *lines: str) -> ScanLog:
    source = tmp_path / "a.log"
    source.write_text("\n".join(lines) + "\n")
    log = import_carmen(source)
    write_log(tmp_path / "a.mcap", log.rows, log.mounts)
    return read_log(tmp_path / "a.mcap")


@pytest.mark.parametrize(("n", "last"), [(180, 89.0), (181, 90.0), (360, 89.5), (361, 90.0)])
def test_180_degrees_begin_at_minus_90(tmp_path: Path, n: int, last: float) -> None:
    scans = imported(tmp_path, flaser(n)).horizontal
    np.testing.assert_allclose(np.degrees(scans.angles[[0, -1]]), [-90.0, last], atol=1e-4)


def test_resolution_of_the_log_serves_unusual_counts(tmp_path: Path) -> None:
    scans = imported(tmp_path, "PARAM laser_front_laser_resolution 0.25 host 0", flaser(1081)).horizontal
    np.testing.assert_allclose(np.degrees(scans.angles[[0, -1]]), [-135.0, 135.0], atol=1e-4)


def test_no_return_from_50_metres_or_the_told_maximum(tmp_path: Path) -> None:
    assert np.isnan(imported(tmp_path, flaser(first=50.0)).horizontal.ranges[0, :2]).all()
    assert imported(tmp_path, flaser(first=49.0)).horizontal.ranges[0, 1] == 49.0
    told = imported(tmp_path, "PARAM robot_front_laser_max 30.0 host 0", flaser(first=31.0))
    assert np.isnan(told.horizontal.ranges[0, :2]).all()


def test_robot_pose_of_a_scan_is_odometry_right_before_it(tmp_path: Path) -> None:
    source = tmp_path / "a.log"
    source.write_text("\n".join([ODOM, flaser(x=-0.04)]))
    rows = import_carmen(source).rows
    assert [type(row) for row in rows] == [OdometryRow, OdometryRow, ScanRow]
    assert [row.time_ns for row in rows] == [100_000_000_001, 100_500_000_000, 100_500_000_000]
    assert isinstance(rows[1], OdometryRow)
    assert rows[1].pose == [1.0, 2.0, 0.0]


def test_mount_from_laser_pose_or_parameter(tmp_path: Path) -> None:
    assert imported(tmp_path, flaser(x=-0.04)).horizontal.mount[0, 3] == pytest.approx(-0.04)
    told = imported(tmp_path, "PARAM robot_frontlaser_offset 0.08 nohost 0", flaser())
    assert told.horizontal.mount[0, 3] == 0.08


def test_rear_laser_is_kept_apart(tmp_path: Path) -> None:
    log = imported(tmp_path, flaser(), *[flaser(keyword="RLASER", time=f"100.{i}") for i in range(6, 9)])
    assert (log.horizontal.topic, len(log.horizontal.time_ns)) == ("/scan_horizontal", 1)
    mounts = describe_log(tmp_path / "a.mcap").mounts
    np.testing.assert_allclose(mounts["/scan_rear"], np.diag([-1.0, -1.0, 1.0, 1.0]), atol=1e-12)


def test_robotlaser_tells_its_angles_and_mount(tmp_path: Path) -> None:
    log = imported(tmp_path, robotlaser("ROBOTLASER1", 0.0), robotlaser("ROBOTLASER2", math.pi))
    np.testing.assert_allclose(log.horizontal.angles, [-2, -1, 0, 1])
    np.testing.assert_array_equal(log.horizontal.ranges, [[1, 2, 30, np.nan]])
    assert log.horizontal.time_ns[0] == 101_500_000_000
    assert log.horizontal.mount[0, 3] == pytest.approx(0.2)
    mounts = describe_log(tmp_path / "a.mcap").mounts
    np.testing.assert_allclose(mounts["/scan_rear"][:2, :2], -np.eye(2), atol=1e-12)


def test_damaged_lines_are_counted_and_the_first_is_named(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    bad = [
        flaser().replace("2.5", "x", 1),
        flaser()[:200],
        "ODOM 1 2",
        "ODOM nan 0 0 0 0 0 1 h 1",
        "FLASER -5 1",
        "PARAM x",
        "FLASER",
    ]
    log = imported(tmp_path, "# comment", "", "SYNC a b", ODOM, *bad, flaser())
    assert len(log.horizontal.time_ns) == 1
    assert "7 damaged lines passed over, first line 5" in caplog.text


def test_stamps_step_back_but_the_order_of_lines_stays(tmp_path: Path) -> None:
    times = ["5.0", "6.0", "5.5", "5.5", "7.0"]
    log = imported(tmp_path, *[flaser(time=t, first=float(i + 1)) for i, t in enumerate(times)])
    np.testing.assert_array_equal(log.horizontal.time_ns, [round(float(t) * 1e9) for t in times])
    np.testing.assert_array_equal(log.horizontal.ranges[:, 1], [1, 2, 3, 4, 5])


def test_gzip_is_known_by_content_and_a_cut_one_gives_its_beginning(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "a.clf"
    packed = gzip.compress("\n".join(flaser(first=1 + i / 100) for i in range(500)).encode())
    path.write_bytes(packed)
    assert len(import_carmen(path).rows) == 1000
    path.write_bytes(packed[: len(packed) * 2 // 3])
    assert 100 < len(import_carmen(path).rows) < 1000
    assert "is damaged or was cut" in caplog.text


def test_what_is_no_carmen_log_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_bytes(bytes(range(256)) * 10)
    with pytest.raises(BadInputError, match=r"no laser scans .*; is it a CARMEN log\?"):
        import_carmen(path)
    with pytest.raises(MissingInputError, match="No such file"):
        import_carmen(tmp_path / "none.log")


@pytest.mark.skipif(not LOGS.is_dir(), reason="no real logs here")
@pytest.mark.parametrize(
    ("name", "scans", "beams", "offset"),
    [("mit-csail", 1051, 361, 0.0), ("aces", 440, 180, 0.0), ("fr101", 292, 360, -0.04), ("fhw", 488, 180, 0.0)],
)
def test_real_logs(tmp_path: Path, name: str, scans: int, beams: int, offset: float) -> None:
    log = import_carmen(LOGS / name / f"{name}.clf.gz")
    write_log(tmp_path / "a.mcap", log.rows, log.mounts)
    read = read_log(tmp_path / "a.mcap")
    assert read.horizontal.ranges.shape == (scans, beams)
    assert read.horizontal.mount[0, 3] == pytest.approx(offset, abs=1e-12)
    assert np.nanmax(read.horizontal.ranges) < 50.0
    assert read.odometry is not None
    poses = [row.pose for row, after in zip(log.rows, log.rows[1:], strict=False) if isinstance(after, ScanRow)]
    np.testing.assert_allclose(read.odometry[:, :2], np.array(poses)[:, :2], atol=1e-9)


@pytest.mark.skipif(not LOGS.is_dir(), reason="no real logs here")
def test_intel_keeps_the_order_of_its_lines(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    log = import_carmen(LOGS / "intel" / "intel.clf.gz")
    write_log(tmp_path / "a.mcap", log.rows, log.mounts)
    read = read_log(tmp_path / "a.mcap")
    stamps = [row.time_ns for row in log.rows if isinstance(row, ScanRow)]
    np.testing.assert_array_equal(read.horizontal.time_ns, stamps)
    poses = [row.pose for row, after in zip(log.rows, log.rows[1:], strict=False) if isinstance(after, ScanRow)]
    assert read.odometry is not None
    np.testing.assert_allclose(read.odometry[:, :2], np.array(poses)[:, :2], atol=1e-9)
    assert "lined up by the time of logging" in caplog.text
