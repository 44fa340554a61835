"""Poses of all scans between better ones of some: what is spread over them, and by what they err."""

import numpy as np
import pytest
from flat_world import along

from bsmap_cli.core import se2
from bsmap_cli.model import LaserScans
from bsmap_cli.slam.between import (
    between,
    drift_covariances,
    evenly,
    left_out,
    match_covariances,
    swept_covariances,
    unmatched,
    within,
)
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.tracking import MATCH_FLOOR, Tracking
from bsmap_cli.slam.visibility import Views

WAY = along([(0.0, 0.0), (6.0, 0.0), (6.0, 4.0), (0.0, 4.0)], 0.05, 0.05)
KEYS = np.arange(0, len(WAY), 6)


def chain(poses: np.ndarray, spread: np.ndarray) -> Edges:
    """From each pose to the next, told with standard deviations `spread` (3,)."""
    m = len(poses) - 1
    information = np.tile(np.diag(1.0 / spread**2), (m, 1, 1))
    return Edges(np.arange(m), np.arange(1, m + 1), se2.between(poses[:-1], poses[1:]), information, np.ones(m, bool))


def tracking_of(poses: np.ndarray, matched: np.ndarray | None = None) -> Tracking:
    """Tracked so, with steps told to be off by a centimetre and 5 mrad beside their allowances."""
    told = np.sqrt(np.array([0.01, 0.01, 0.005]) ** 2 + MATCH_FLOOR**2)
    no, every = np.zeros(len(KEYS), bool), np.ones(len(poses), bool)
    edges = chain(poses[KEYS], told)
    matched = every if matched is None else matched
    return Tracking(
        poses, KEYS, [], edges, edges.information, no, no, 1.0, matched, Views(scans_of(np.arange(len(poses)), 0.0))
    )


def scans_of(stamps: np.ndarray, time_increment: float) -> LaserScans:
    ranges = np.ones((len(stamps), 100), np.float32)
    return LaserScans((stamps * 1e9).astype(np.int64), ranges, -1.0, 0.02, time_increment, 0.1, 10.0, np.eye(4))


def test_motion_is_kept_and_what_it_misses_is_spread():
    known = np.array([0, 10, 20])
    poses = np.array([[0.0, 0, 0], [1.0, 0.1, 0], [2.0, 0.2, 0]])
    motion = np.column_stack([np.arange(25) / 10.0, np.zeros(25), np.zeros(25)])
    found = between(known, poses, motion)
    np.testing.assert_allclose(found.poses[:21, 1], np.arange(21) / 100, atol=1e-12)
    np.testing.assert_allclose(found.poses[21:, 1], 0.2)
    np.testing.assert_allclose(found.share[[0, 5, 10, 13, 22]], [0, 0.5, 0, 0.3, 0])


def test_break_is_not_spread():
    poses = np.array([[0.0, 0, 0], [9.0, 0, 0]])
    found = between(np.array([0, 4]), poses, np.zeros((5, 3)))
    np.testing.assert_array_equal(found.poses, np.repeat(poses, [4, 1], axis=0))


def test_key_scans_left_out_are_off_by_what_was_added_to_them():
    rng = np.random.default_rng(0)
    poses = WAY[KEYS] + [0.002, 0.002, 0.001] * rng.normal(size=(len(KEYS), 3))
    rows, miss = left_out(KEYS, poses, WAY)
    assert sorted(rows.tolist()) == list(range(1, len(KEYS) - 1))
    away = se2.between(poses, WAY[KEYS])
    expected = away[1:-1] - (away[:-2] + away[2:]) / 2
    np.testing.assert_allclose(miss[np.argsort(rows)][:, 2], expected[:, 2], atol=1e-9)


@pytest.mark.parametrize("scale", [0.1, 0.6])
def test_errors_of_matches_are_as_large_as_key_scans_tell(scale):
    """Matches with white noise around the true poses; the tenfold told is not believed."""
    noise, ratios = scale * np.array([0.005, 0.005, 0.002]), []
    for seed in range(60):
        tracked = WAY + noise * np.random.default_rng(seed).normal(size=WAY.shape)
        told = match_covariances(tracking_of(tracked), WAY[KEYS])
        inner = between(KEYS, WAY[KEYS], tracked)
        miss = se2.between(WAY, inner.poses)[(inner.share > 0) & (inner.share < 1)]
        ratios.append((miss**2).mean(axis=0) / np.diagonal(told.mean(axis=0)))
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, rtol=0.2)


def test_drift_is_as_large_as_the_poses_tell():
    rng = np.random.default_rng(1)
    noise, told = np.array([0.01, 0.002, 0.004]), np.array([0.05, 0.05, 0.02])
    edges = chain(WAY[KEYS], told)
    edges = edges._replace(relative=edges.relative + noise * rng.normal(size=edges.relative.shape))
    found = np.sqrt(np.diagonal(drift_covariances(edges, WAY[KEYS])[0]))
    np.testing.assert_allclose(found, noise, rtol=0.35)


def test_odometry_between_two_matches_is_known_at_both_ends():
    matched = np.zeros(len(WAY), bool)
    matched[KEYS[0] + 2] = True
    share = unmatched(tracking_of(WAY, matched))
    np.testing.assert_array_equal(share[[0, 2, 6]], 0.0)
    assert share[1] == pytest.approx(0.5 / 6)  # a step of one scan either way
    assert share[4] == pytest.approx(1.0 / 6)
    assert (share[KEYS] == 0).all()


def test_what_odometry_misses_between_matches_comes_bit_by_bit():
    odometry = np.column_stack([np.arange(13) * 0.1, np.zeros(13), np.zeros(13)])
    poses = odometry.copy()
    poses[6:, 1] = 0.06
    tracking = tracking_of(WAY)._replace(poses=poses, keys=np.array([0, 6, 12]), matched=np.zeros(13, bool))
    np.testing.assert_allclose(evenly(tracking, odometry).poses[:7, 1], np.arange(7) * 0.01, atol=1e-12)


def test_share_of_the_way_within_a_scan():
    stamps = np.array([0.0, 0.1, 0.2, 0.2, 1.2])
    np.testing.assert_allclose(within(scans_of(stamps, 0.0005))[:4], [0.25, 0.25, 0.5, 0.025])
    np.testing.assert_array_equal(within(scans_of(stamps, 0.0)), 0.0)


def test_scans_in_which_the_motion_changes_are_known_less():
    stamps = np.arange(20) * 0.1
    poses = np.column_stack([np.zeros((20, 2)), np.concatenate([np.zeros(10), 0.05 * np.arange(10)])])
    found = swept_covariances(scans_of(stamps, 0.0005), poses, np.zeros((20, 3, 3)))
    spread = np.sqrt(found[:, 2, 2])
    assert np.argmax(spread) in (9, 10)
    assert spread.max() == pytest.approx(0.25 * 0.05 / np.sqrt(3))
    np.testing.assert_allclose(np.delete(spread, [9, 10, 19]), 0.0, atol=1e-12)
