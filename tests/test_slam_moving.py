"""People who walk along with the robot: told by beams that pass where they stood."""

import numpy as np
import pytest
from flat_world import SIGMA, along, box, in_first, log_of, polygon

from bsmap_cli.params import SlamParams
from bsmap_cli.slam.matching import OrientedPoints
from bsmap_cli.slam.moving import Watch
from bsmap_cli.slam.tracking import track_scans
from bsmap_cli.slam.visibility import Views
from bsmap_cli.track import silent

CORRIDOR = polygon((-1, -1), (31, -1), (31, 1), (-1, 1))
"""Bare but for its ends."""


def with_company(way: np.ndarray, ahead: list[float], side: float = 0.5) -> np.ndarray:
    """Walls (n, k, 2, 2) of the corridor, and people who keep so far ahead of the robot, from when it sets out."""
    bodies = np.concatenate([box(a - 0.15, side - 0.15, a + 0.15, side + 0.15) for a in ahead])
    return np.array([np.concatenate([CORRIDOR, np.add(bodies, [pose[0], 0.0])]) for pose in way])


def watched(log, way: np.ndarray, step: int = 5, sure: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Points of every `step`-th scan, at true poses, and whether they are told to move."""
    scans, views, found = log.horizontal, Views(log.horizontal), []
    watch = Watch(views)
    for k in range(0, len(way), step):
        c, s = np.cos(scans.angles + way[k, 2]), np.sin(scans.angles + way[k, 2])
        seen = np.isfinite(scans.ranges[k])
        xy = way[k, :2] + (scans.ranges[k] * np.array([c, s])).T[seen].astype(float)
        found.append((xy, watch.add(views.view(k, way[k]), OrientedPoints(xy, np.zeros_like(xy)), sure)))
    return tuple(np.concatenate(part) for part in zip(*found, strict=True))


@pytest.mark.parametrize("ahead", [-1.5, 1.5])
def test_company_moves_and_walls_do_not(ahead):
    way = along([(3.0, 0.0), (20.0, 0.0)], 0.07)
    xy, moves = watched(log_of(with_company(way, [ahead]), way), way)
    body = (np.abs(xy[:, 1] - 0.5) < 0.2) & (xy[:, 0] > 6.0) & (xy[:, 0] < 18.0)
    walls = np.abs(np.abs(xy[:, 1]) - 1.0) < 0.05
    assert moves[body].mean() > 0.9
    assert moves[walls].mean() < 0.003


def test_nothing_is_told_by_poses_that_are_not_sure():
    way = along([(3.0, 0.0), (9.0, 0.0)], 0.07)
    assert not watched(log_of(with_company(way, [1.5]), way), way, sure=False)[1].any()


def test_pose_that_is_wrong_makes_no_wall_move():
    """Half of a scan would: then it is the pose."""
    way = along([(3.0, 0.0), (9.0, 0.0)], 0.07)
    wrong = way.copy()
    wrong[50:, 1] += 2.0
    assert watched(log_of(CORRIDOR, way), wrong)[1].mean() < 0.1


def test_what_stands_in_the_open_stays():
    """A pillar is passed by beams on both sides, and seen from all."""
    way = along([(3.0, -0.5), (20.0, -0.5)], 0.07)
    pillars = np.concatenate([CORRIDOR, *(box(x, 0.3, x + 0.12, 0.42) for x in (6.0, 11.0, 15.0))])
    xy, moves = watched(log_of(pillars, way), way)
    pillar = np.abs(xy[:, 1] - 0.36) < 0.1
    assert pillar.sum() > 200
    assert moves[pillar].mean() < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_company_in_a_bare_corridor_does_not_hold_the_robot_back(seed):
    """Of the way along the corridor only those who walk with it show anything, to a laser that sees 8 metres."""
    way = along([(0.0, 0.0), (29.0, 0.0)], 0.05)
    log = log_of(with_company(way, [-1.2, -2.0]), way, seed)
    log.horizontal.ranges[log.horizontal.ranges > 8.0] = np.nan
    tracking = track_scans(log, SIGMA, SlamParams(), silent)
    away = np.hypot(*(tracking.poses - in_first(way))[:, :2].T)
    assert away[tracking.keys].max() < 0.5
    bodies = [np.abs(points.xy[:, 1] - 0.5) < 0.2 for points in tracking.points[3:-8]]
    assert np.concatenate(bodies).mean() < 0.01


@pytest.mark.parametrize("seed", range(2))
def test_company_all_round_does_not_take_the_robot_along(seed):
    """Matched to six who walk with it the robot would stand; what odometry tells is less wrong by far."""
    way = along([(3.0, 0.0), (15.0, 0.0)], 0.07)
    log = log_of(with_company(way, [1.0, 1.6, 2.4, -1.0, -1.6, -2.4]), way, seed)
    log.horizontal.ranges[log.horizontal.ranges > 8.0] = np.nan
    tracking = track_scans(log, SIGMA, SlamParams(), silent)
    away = np.hypot(*(tracking.poses - in_first(way))[:, :2].T)
    assert len(tracking.keys) > 30
    assert away[tracking.keys].max() < 1.2
