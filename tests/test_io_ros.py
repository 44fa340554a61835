"""ROS messages that differ by their numbers alone, encoded at once."""

import numpy as np
import pytest

from bsmap_cli.io import ros
from bsmap_cli.model import Array

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
