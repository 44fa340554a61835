"""A lost track is found again by what places look like; where they look like none, it stays as odometry has it."""

from dataclasses import replace

import numpy as np
from flat_world import SIGMA, along, box, in_first, log_of, polygon, ring, room, wall_points

from bsmap_cli.core import se2
from bsmap_cli.model import ScanLog
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import run_slam
from bsmap_cli.slam.loops import close_loops, lost_runs
from bsmap_cli.slam.matching import OrientedPoints
from bsmap_cli.slam.recognition import TURN_STEP, fingerprint, likely_turns
from bsmap_cli.slam.tracking import adrift, track_scans
from bsmap_cli.track import silent

FIRST = along([(-1, -1), (15, -1), (15, 9), (-1, 9)], 0.15, 0.15)
SECOND = along([(15, 4), (15, 9), (3, 9)], 0.15, 0.15)


def one_after_another(*logs: ScanLog, pause: float = 60.0) -> ScanLog:
    """One log of several; each one's odometry begins at 0, as when a robot is switched off, carried and started."""
    times, at = [], 0
    for log in logs:
        times.append(log.horizontal.time_ns + at)
        at = int(times[-1][-1] + pause * 1e9)
    ranges = np.concatenate([log.horizontal.ranges for log in logs])
    scans = replace(logs[0].horizontal, time_ns=np.concatenate(times), ranges=ranges)
    return ScanLog(scans, np.concatenate([log.odometry for log in logs if log.odometry is not None]), None)


def test_robot_that_was_carried_is_found_where_it_was_put():
    log = one_after_another(log_of(ring(), FIRST, beams=240), log_of(ring(), SECOND, seed=1, beams=240))
    tracking = track_scans(log, SIGMA, SlamParams(), silent)
    assert len(lost_runs(tracking)) == 1
    truth = se2.between(FIRST[0], np.concatenate([FIRST, SECOND]))
    lost = np.hypot(*(tracking.poses - truth)[:, :2].T)[len(FIRST) :]
    assert np.median(lost) > 1.0, "it is another place that the odometry tells"
    found = run_slam(log, SlamParams()).trajectory.poses
    away = np.hypot(*(found - truth)[:, :2].T)
    assert away[: len(FIRST)].max() < 0.15
    assert away[len(FIRST) + 1 :].max() < 0.15


def test_robot_that_was_carried_to_a_place_not_seen_before_stays_where_odometry_has_it():
    other = np.concatenate([polygon((-6, -2), (7, -2), (7, 5), (2, 5), (2, 2.5), (-6, 2.5)), box(3, 0, 3.8, 2.2)])
    way = along([(-5, -1), (5.5, -1), (5.5, 4)], 0.15, 0.15)
    log = one_after_another(log_of(ring(), FIRST, beams=240), log_of(other, way, seed=1, beams=240))
    tracking = track_scans(log, SIGMA, SlamParams(), silent)
    found = close_loops(tracking, SIGMA, silent)
    before = int(np.searchsorted(tracking.keys, len(FIRST)))
    assert not np.any((found.closures.first < before) & (found.closures.second >= before + 2))
    steps = se2.between(found.poses[before + 3], found.poses[before + 3 :])
    true = in_first(way[tracking.keys[before + 3 :] - len(FIRST)])
    np.testing.assert_allclose(steps, true, atol=0.1)


def test_robot_whose_odometry_is_whole_is_not_taken_for_lost():
    log = log_of(ring(), FIRST, beams=240)
    tracking = track_scans(log, SIGMA, SlamParams(), silent)
    assert not tracking.adrift.any()
    assert lost_runs(tracking) == []
    without = track_scans(log_of(ring(), FIRST[:40], odometry_error=None, beams=240), SIGMA, SlamParams(), silent)
    assert without.adrift[1:].all()


def test_gap_in_which_odometry_goes_on_as_ever_is_a_stand():
    """Logs of a scan a metre have long gaps where the robot stands; only a step like no other, or none, is doubtful."""
    odometry = np.column_stack([np.arange(12.0), np.zeros((12, 2))])
    odometry[8:, 0] += 4.0
    odometry[10:] = odometry[:2]
    scans = log_of(room(), odometry * 0.1).horizontal
    scans = replace(scans, time_ns=np.cumsum([0, *[2 + 40 * (k in (3, 7, 9)) for k in range(11)]]) * 10**9)
    keys = np.arange(12)
    assert np.flatnonzero(adrift(ScanLog(scans, odometry, None), keys)).tolist() == [8, 10]
    stands = odometry.copy()
    stands[4:] -= odometry[4] - odometry[3]
    assert np.flatnonzero(adrift(ScanLog(scans, stands, None), keys)).tolist() == [4, 8, 10]


def test_fingerprint_is_the_same_from_wherever_a_place_is_looked_at():
    seen = wall_points(room(), (0.0, 0.0))
    turned = seen.moved(np.array([3.0, -7.0, 2.0]))
    np.testing.assert_allclose(fingerprint(turned), fingerprint(seen), atol=0.01)
    assert fingerprint(seen).sum() == 1.0
    other = wall_points(ring(), (-1.0, -1.0))
    assert np.abs(fingerprint(other) - fingerprint(seen)).sum() > 0.2
    none = OrientedPoints(np.zeros((0, 2)), np.zeros((0, 2)))
    assert fingerprint(none).sum() == 0.0


def test_likely_turns_hold_the_true_one():
    seen = wall_points(room(), (0.0, 0.0))
    for turn in (0.0, 0.4, 2.0, -1.3, 3.1):
        turned = seen.moved(np.array([3.0, -7.0, turn]))
        found = likely_turns(seen.normal, turned.normal)
        assert min(abs(se2.wrap(np.array(found) - turn))) < TURN_STEP
        assert len(found) <= 6
