"""Tracking in small worlds of known truth: standing still, people, no odometry, scans that show nothing."""

from dataclasses import replace

import numpy as np
import pytest
from flat_world import SIGMA, along, box, in_first, log_of, polygon, room

from bsmap_cli.core import se2
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import run_slam
from bsmap_cli.slam.tracking import Tracking, track_scans
from bsmap_cli.track import silent

WAY = [(-3.0, -2.0), (2.0, -2.0), (3.0, 0.0), (1.0, 2.2), (-1.5, 0.5)]


def tracked(log, params: SlamParams | None = None) -> Tracking:
    return track_scans(log, SIGMA, params or SlamParams(), silent)


def place_errors(tracking: Tracking, truth: np.ndarray) -> np.ndarray:
    return np.hypot(*(tracking.poses - in_first(truth))[:, :2].T)


@pytest.mark.parametrize("odometry_error", [0.02, 0.15])
def test_room_is_tracked_whatever_the_odometry(odometry_error):
    truth = along(WAY, 0.1)
    tracking = tracked(log_of(room(), truth, odometry_error=odometry_error))
    assert place_errors(tracking, truth)[tracking.keys].max() < 0.02
    assert np.abs(se2.wrap(tracking.poses - in_first(truth))[tracking.keys, 2]).max() < 0.01
    assert not tracking.weak.any()
    assert np.all(np.diff(tracking.keys) > 0)


@pytest.mark.parametrize("odometry_error", [0.02, None], ids=["odometry", "no odometry"])
def test_standing_still_adds_nothing(odometry_error):
    """However long it stands: one key scan, and so no memory for more."""
    truth = np.tile([0.5, -0.5, 0.3], (400, 1))
    tracking = tracked(log_of(room(), truth, odometry_error=odometry_error))
    assert tracking.keys.tolist() == [0]
    assert len(tracking.points) == 1
    assert len(tracking.edges.first) == 0
    assert place_errors(tracking, truth).max() < 0.005


def test_standing_again_and_again_adds_no_key_scans():
    moving = along(WAY[:3], 0.1)
    stops = np.repeat(moving, np.where(np.arange(len(moving)) % 20 == 0, 60, 1), axis=0)
    one, other = tracked(log_of(room(), moving)), tracked(log_of(room(), stops))
    assert abs(len(one.keys) - len(other.keys)) <= 2
    assert place_errors(other, stops).max() < 0.02


def with_people(truth: np.ndarray, seed: int, count: int = 4) -> np.ndarray:
    """Walls (n, k, 2, 2) of the room and people at each pose: octagons 45 cm wide that walk at random."""
    rng = np.random.default_rng(seed)
    angles = np.arange(8) * np.pi / 4
    shape = polygon(*(0.22 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)))
    place = rng.uniform([-2, -2], [3, 2.5], (count, 2))
    velocity = rng.normal(size=(count, 2)) * 0.1
    every = []
    for pose in truth:
        velocity = 0.9 * velocity + 0.05 * rng.normal(size=velocity.shape)
        place = np.clip(place + velocity, [-3.5, -2.4], [3.5, 2.6])
        away = place - pose[:2]
        far = np.maximum(np.hypot(*away.T), 0.1)[:, None]
        place = np.where(far < 0.7, pose[:2] + 0.7 * away / far, place)
        people = (shape + place[:, None, None]).reshape(-1, 2, 2)
        every.append(np.concatenate([room(), people]))
    return np.array(every)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_people_who_walk_about_do_not_pull_the_pose_nor_enter_the_map(seed):
    truth = along(WAY, 0.1)
    alone, among = log_of(room(), truth, seed), log_of(with_people(truth, seed), truth, seed)
    keys = tracked(among).keys
    assert place_errors(tracked(among), truth)[keys].max() < 0.02
    without, slam = run_slam(alone, SlamParams()), run_slam(among, SlamParams())
    difference = np.hypot(*(slam.trajectory.poses - without.trajectory.poses)[keys, :2].T)
    assert np.median(difference) < 0.006
    assert abs(len(slam.lines.hits) - len(without.lines.hits)) <= 2


@pytest.mark.parametrize("rate", [10.0, 40.0])
def test_without_odometry_scans_alone_tell_the_way(rate):
    truth = along([(-3.0, -2.0), (2.0, -2.0), (3.0, 0.0), (1.0, 2.2)], 0.5 / rate, turn=1.0 / rate)
    tracking = tracked(log_of(room(), truth, rate=rate, odometry_error=None, beams=240))
    assert place_errors(tracking, truth).max() < 0.05
    assert len(tracking.keys) < 60


def test_one_false_reading_of_the_odometry_is_found_and_overruled():
    truth = along(WAY[:3], 0.1)
    log = log_of(room(), truth)
    odometry = log.odometry.copy()
    odometry[30:] = se2.compose(np.array([0.0, 0.0, 0.5]), odometry[30:])
    odometry[30:, :2] += [0.6, -0.4]
    tracking = tracked(replace(log, odometry=odometry))
    assert place_errors(tracking, truth)[tracking.keys].max() < 0.02


def test_scans_without_returns_go_by_odometry_and_the_next_one_finds_the_map():
    truth = along(WAY[:2], 0.1)
    log = log_of(room(), truth)
    ranges = log.horizontal.ranges.copy()
    ranges[20:26] = np.nan
    tracking = tracked(replace(log, horizontal=replace(log.horizontal, ranges=ranges)))
    assert place_errors(tracking, truth).max() < 0.05
    assert place_errors(tracking, truth)[-10:].max() < 0.02


def test_box_that_is_moved_away_does_not_hold_the_robot_back():
    truth = along([(-3.0, -2.0), (2.0, -2.0)], 0.1)
    n = len(truth)
    late = np.concatenate([room(), box(-1.0, 0.6, -0.2, 1.4)])
    early = np.concatenate([room(), box(-1.4, 0.9, -0.6, 1.7)])
    walls = np.array([early if k < n // 2 else late for k in range(n)])
    tracking = tracked(log_of(walls, truth))
    assert place_errors(tracking, truth)[tracking.keys].max() < 0.02
