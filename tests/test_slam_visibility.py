"""What scan and map agree on of what both could see; robots that drive backwards and turn into what is new."""

import numpy as np
import pytest
from flat_world import SIGMA, along, box, in_first, log_of, polygon, ring, wall_points

from bsmap_cli.core import se2
from bsmap_cli.params import SlamParams
from bsmap_cli.slam.matching import Match, OrientedPoints, make_target
from bsmap_cli.slam.tracking import track_scans
from bsmap_cli.slam.visibility import SHORT, LocalMap, Views, agreeing, free_ranges
from bsmap_cli.track import silent

ROOM = polygon((-4, -3), (4, -3), (4, 3), (-4, 3))
PILLARED = np.concatenate(
    [polygon((-1, -1), (31, -1), (31, 1), (-1, 1)), *(box(x, -1, x + 0.3, -0.7) for x in (3, 8, 12, 19, 25))]
)
"""A corridor with pilasters."""


def test_free_is_less_than_the_shortest_beam_beside_and_unknown_without_return():
    ranges = np.full(100, 5.0)
    ranges[50], ranges[80] = 2.0, 0.0
    free = free_ranges(ranges, 0.02)
    assert free[10] == pytest.approx(5.0 - SHORT)
    np.testing.assert_allclose(free[48:53], 2.0 - SHORT)
    assert (free[78:83] <= 0).all()


def test_beams_pass_and_end_where_they_do():
    log = log_of(ROOM, np.array([[1.0, 0.5, 0.7]]), sigma=0.0)
    views = Views(log.horizontal)
    seen = [views.view(0, np.array([1.0, 0.5, 0.7]))]
    at = np.array([0.0 + 0j, 3.0 + 2j, 4.0 + 0.5j, -4.0 - 2j, 5.0 + 0j])
    assert views.through(at, seen)[0].tolist() == [True, True, False, False, False]
    assert views.ends(at, seen)[0].tolist() == [False, False, True, True, False]
    assert views.through(at, []).shape == (0, 5)


def forward(log):
    """The log with what lies behind the laser taken away."""
    log.horizontal.ranges[:, np.abs(log.horizontal.angles) > np.pi / 2] = np.nan
    return log


def seen_at(log, k: int, walls: np.ndarray) -> OrientedPoints:
    """Points of a scan in its own frame, with the normals of the axis-parallel walls on which they lie."""
    scans, pose = log.horizontal, np.zeros(3)
    r = scans.ranges[k].astype(float)
    at = (r * np.array([np.cos(scans.angles), np.sin(scans.angles)])).T[np.isfinite(r)]
    points = wall_points(walls, (0.0, 0.0))
    nearest = np.hypot(*(at[:, None] - points.xy[None]).transpose(2, 0, 1)).argmin(axis=1)
    return OrientedPoints(at, points.normal[nearest]).moved(pose)


def test_new_sights_contradict_nothing_but_walls_in_the_open_do():
    """One looked one way from the middle of a room, and now looks the other way: nothing is known, a quarter is."""
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    log = log_of(ROOM, poses)
    ahead = np.abs(log.horizontal.angles) < np.pi / 2
    log.horizontal.ranges[0, ~ahead] = np.nan
    log.horizontal.ranges[1, np.abs(log.horizontal.angles - np.pi / 2) > np.pi / 2] = np.nan
    views, first, second = Views(log.horizontal), seen_at(log, 0, ROOM), seen_at(log, 1, ROOM)
    local = LocalMap(make_target(first), [views.view(0, poses[0])], views)

    def at(pose: list[float]) -> float:
        return agreeing(Match(np.array(pose), np.eye(3), 0.4, 0.0), 1, second, local, 0.03)

    assert at([0.0, 0.0, 0.0]) > 0.98
    assert at([-1.5, 0.0, 0.0]) < 0.7
    assert at([0.0, -1.5, 0.0]) < 0.7
    assert at([0.0, 20.0, 0.0]) == 0.4, "too little of it is on the map"


@pytest.mark.parametrize("seed", range(3))
def test_robot_that_drives_backwards_is_tracked(seed):
    """A scan a metre, and of each almost half is new."""
    way = np.add(along([(28.0, 0.0), (1.0, 0.0)], 1.0), [0, 0, np.pi])
    tracking = track_scans(forward(log_of(PILLARED, way, seed)), SIGMA, SlamParams(), silent)
    steps, true = (se2.between(poses[:-1], poses[1:]) for poses in (tracking.poses, way))
    assert not tracking.weak.any()
    assert np.hypot(*(steps - true)[:, :2].T).max() < 0.15


@pytest.mark.parametrize("seed", range(3))
def test_robot_that_turns_into_what_is_new_is_tracked(seed):
    """Round the corners of a ring with scans half a metre and a third of a right angle apart."""
    way = along([(-1, -1), (15, -1), (15, 9), (-1, 9)], 0.5, 0.52)
    tracking = track_scans(forward(log_of(ring(), way, seed)), SIGMA, SlamParams(), silent)
    error = se2.between(tracking.poses, in_first(way))
    assert not tracking.weak.any()
    assert np.hypot(error[:, 0], error[:, 1]).max() < 0.15
