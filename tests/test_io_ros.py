"""ROS messages that differ by their numbers alone, encoded at once and read without decoding them as a whole."""

import numpy as np
import pytest

from bsmap_cli.io import ros
from bsmap_cli.model import Array, LaserScans

TIMES = 1_700_000_000_123_456_789 + 987_654_321 * np.arange(7)


def pose(time_ns: int, numbers: Array) -> object:
    full = ros.pose_with_covariance(ros.pose_of_numbers(numbers[:4]), numbers[4:].reshape(3, 3))
    return ros.make(ros.POSE_WITH_COVARIANCE, header=ros.header(time_ns, "map"), pose=full)


def transform(time_ns: int, numbers: Array) -> object:
    return ros.tf_message([ros.planar_transform(numbers, time_ns, "map", "base_link")])


@pytest.mark.parametrize(("message_of", "count"), [(pose, 13), (transform, 4)])
def test_encoded_at_once_is_the_same_as_one_by_one(message_of, count):
    numbers = np.random.default_rng(0).normal(size=(len(TIMES), count))
    one_by_one = [ros.encode(message_of(int(t), row)) for t, row in zip(TIMES, numbers, strict=True)]
    assert ros.encode_alike(message_of, TIMES, numbers) == one_by_one


def test_messages_without_a_stamp_are_encoded_at_once_too():
    numbers = np.random.default_rng(0).normal(size=(len(TIMES), 5))
    one_by_one = [ros.encode(ros.numbers_message(row, "five")) for row in numbers]
    assert ros.encode_alike(lambda _, row: ros.numbers_message(row, "five"), TIMES, numbers) == one_by_one


def test_a_number_that_stands_twice_is_refused():
    with pytest.raises(ValueError, match="more than once"):
        ros.encode_alike(lambda _, row: ros.numbers_message(np.tile(row, 2), "twice"), TIMES, np.ones((7, 2)))


def test_pose_message_has_the_heading_as_a_quaternion():
    message = ros.pose_message((1.0, -2.0, 0.3))
    assert ros.planar_pose(message) == pytest.approx((1.0, -2.0, 0.3), abs=1e-15)


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_encoded_path_is_that_of_its_message(count):
    poses = np.random.default_rng(1).normal(size=(count, 3))
    stamped = [
        ros.make("geometry_msgs/msg/PoseStamped", header=ros.header(int(t), "map"), pose=ros.pose_message(pose))
        for t, pose in zip(TIMES, poses, strict=False)
    ]
    message = ros.make(ros.PATH, header=ros.header(5, "map"), poses=stamped)
    assert ros.encode_path(TIMES[:count], poses, 5) == ros.encode(message)


def laser(frame_id: str = "laser", angle_min: float = -1.5) -> LaserScans:
    return LaserScans(
        TIMES, np.ones((len(TIMES), 5), np.float32), angle_min, 0.1, 1e-4, 0.1, 30.0, np.eye(4), frame_id, "/scan"
    )


def scan(ranges: Array, **kwargs: object) -> bytes:
    return ros.encode(ros.scan_of(laser(**kwargs), int(TIMES[1]), ranges.astype(np.float32)))


def test_scans_alike_are_read_as_they_are_decoded():
    first, second = (scan(np.random.default_rng(k).uniform(1, 9, 5)) for k in (0, 1))
    alike = ros.alike_scans(first, ros.decode(first, ros.LASER_SCAN))
    assert alike is not None
    assert alike.fits(second)
    decoded = ros.decode(second, ros.LASER_SCAN)
    np.testing.assert_array_equal(ros.ranges_at(second, alike.start, 5), decoded.ranges)
    assert ros.stamp_at(second) == ros.time_of(decoded) == TIMES[1]


@pytest.mark.parametrize(
    "other",
    [
        scan(np.arange(6.0)),
        scan(np.arange(5.0), angle_min=-1.4),
        scan(np.arange(5.0), frame_id="other"),
        scan(np.arange(5.0), frame_id="laser_front"),
        scan(np.arange(5.0))[:-1],
        b"\x00\x00" + scan(np.arange(5.0))[2:],
        b"",
    ],
)
def test_scan_of_another_layout_does_not_fit(other):
    data = scan(np.arange(5.0))
    alike = ros.alike_scans(data, ros.decode(data, ros.LASER_SCAN))
    assert alike is not None
    assert not alike.fits(other)


def test_range_that_became_an_intensity_does_not_fit():
    message = ros.scan_of(laser(), int(TIMES[0]), np.ones(5, np.float32))
    data = ros.encode(message)
    alike = ros.alike_scans(data, ros.decode(data, ros.LASER_SCAN))
    message.ranges, message.intensities = message.ranges[:4], np.ones(1, np.float32)
    assert alike is not None
    assert len(ros.encode(message)) == len(data)
    assert not alike.fits(ros.encode(message))


def test_odometry_alike_is_read_as_it_is_decoded():
    first, second = (ros.odometry_message(int(TIMES[k]), (0.1 * k, -0.2, 3.0 - k)) for k in (0, 1))
    second.pose.covariance[:] = np.arange(36)
    data, other = ros.encode(first), ros.encode(second)
    alike = ros.alike_odometry(data, ros.decode(data, ros.ODOMETRY))
    assert alike is not None
    assert alike.fits(other)
    assert ros.pose_at(other, alike.start) == ros.planar_pose(ros.decode(other, ros.ODOMETRY).pose.pose)
    renamed = ros.encode(ros.odometry_message(int(TIMES[0]), (0, 0, 0), "map!"))
    assert len(renamed) == len(data)
    assert not alike.fits(renamed)


def test_big_endian_messages_and_empty_scans_are_decoded_as_a_whole():
    empty, data = scan(np.zeros(0)), scan(np.arange(5.0))
    assert ros.alike_scans(empty, ros.decode(empty, ros.LASER_SCAN)) is None
    assert ros.alike_scans(b"\x00\x00" + data[2:], ros.decode(data, ros.LASER_SCAN)) is None
