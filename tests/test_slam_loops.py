"""Loops: closed where the robot was before, refused where one place only looks like another."""

from dataclasses import replace

import numpy as np
import pytest
from flat_world import SIGMA, along, box, in_first, log_of, polygon, ring, room

from bsmap_cli.core import se2
from bsmap_cli.model import ScanLog
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import loops, run_slam
from bsmap_cli.slam.candidates import far_candidates, is_loop
from bsmap_cli.slam.loops import close_loops
from bsmap_cli.slam.matching import OrientedPoints, make_target
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.recognition import FEWEST_WITNESSES, witnesses
from bsmap_cli.slam.submaps import Search, register, revisit, target_map
from bsmap_cli.slam.tracking import Tracking, track_scans
from bsmap_cli.slam.visibility import Views
from bsmap_cli.track import silent

ROUND = along([(-1, -1), (15, -1), (15, 9), (-1, 9), (-1, -1), (6, -1)], 0.15, 0.15)


def tracked(log: ScanLog) -> Tracking:
    return track_scans(log, SIGMA, SlamParams(), silent)


def bent(tracking: Tracking, turn: float, stretch: float = 1.0) -> Tracking:
    """The tracking as it would be if each step to a key scan were turned by so many radians more, and longer."""
    edges = tracking.edges
    relative = se2.compose(edges.relative * [stretch, stretch, 1.0], np.array([0.0, 0.0, turn]))
    poses = tracking.poses[tracking.keys]
    for k, (first, second) in enumerate(zip(edges.first, edges.second, strict=True)):
        poses[second] = se2.compose(poses[first], relative[k])
    every = tracking.poses.copy()
    every[tracking.keys] = poses
    return tracking._replace(poses=every, edges=edges._replace(relative=relative))


def place_errors(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return np.hypot(*(poses - truth)[:, :2].T)


def wrong(closures: Edges, truth: np.ndarray) -> np.ndarray:
    """Metres by which closures differ from the truth (n, 3) of the key scans."""
    measured = se2.between(se2.between(truth[closures.first], truth[closures.second]), closures.relative)
    return np.hypot(measured[:, 0], measured[:, 1])


@pytest.fixture(scope="module")
def lap() -> tuple[Tracking, np.ndarray]:
    """Once round the block and 7 m more, and the truth at the key scans."""
    tracking = tracked(log_of(ring(), ROUND, beams=240))
    return tracking, in_first(ROUND)[tracking.keys]


@pytest.mark.parametrize(("turn", "stretch"), [(0.0, 1.0), (0.001, 1.0), (-0.0015, 1.01), (0.0, 0.98)])
def test_lap_closes_however_tracking_bent_it(lap, turn, stretch):
    tracking, truth = lap
    drifted = bent(tracking, turn, stretch)
    before = place_errors(drifted.poses[tracking.keys], truth)
    found = close_loops(drifted, SIGMA, silent)
    after = place_errors(found.poses, truth)
    assert len(found.closures.first) >= 3
    assert wrong(found.closures, truth).max() < 0.1
    assert np.all(is_loop(found.poses, found.closures))
    ends = np.abs(np.diff([found.closures.first, found.closures.second], axis=0)).min()
    assert ends > 20, "key scans of one visit are no loop"
    last = len(truth) - 1
    first = int(np.argmin(np.hypot(*(truth[: last // 2] - truth[last])[:, :2].T)))
    again = se2.between(found.poses[first], found.poses[last]) - se2.between(truth[first], truth[last])
    assert np.hypot(*again[:2]) < 0.05, "where it was before, it is again"
    # That the whole is too small no loop can tell.
    assert after.max() < max(0.15, 0.6 * before.max()) if turn else after.max() < before.max() + 0.05


def test_way_that_never_returns_has_no_loops():
    way = along([(-1, -1), (15, -1), (15, 9)], 0.2, 0.2)
    found = close_loops(tracked(log_of(ring(), way, beams=180)), SIGMA, silent)
    assert len(found.closures.first) == len(found.refused.first) == 0


def test_standing_turning_robot_makes_no_loops():
    way = np.c_[np.full((80, 2), -1.0), np.arange(80) * 0.2]
    found = close_loops(tracked(log_of(ring(), way, beams=180)), SIGMA, silent)
    assert len(found.closures.first) == 0


def twin_corridors() -> tuple[np.ndarray, np.ndarray]:
    """Two corridors side by side, 2.2 m apart, that look the same, joined at one end; and a way out and back."""

    def niches(y: float, side: int) -> list[tuple[float, float]]:
        depth = 0.4 * side
        return [(3, y), (3, y + depth), (4.3, y + depth), (4.3, y), (8, y), (8, y + depth), (8.7, y + depth), (8.7, y)]

    lower, upper = 0.0, 2.2
    outline = polygon(
        (-1, lower - 0.7), *niches(lower - 0.7, -1), (16, lower - 0.7), (16, upper + 0.7), (-1, upper + 0.7),
        (-1, upper - 0.7), *niches(upper - 0.7, -1), (14, upper - 0.7), (14, lower + 0.7), (-1, lower + 0.7),
    )  # fmt: skip
    way = along([(0, lower), (15, lower), (15, upper), (0.5, upper)], 0.15, 0.15)
    return np.concatenate([outline, box(15.6, -0.6, 15.9, -0.3)]), way


def test_places_alike_side_by_side_are_not_taken_for_one():
    """The matches are as good as any and agree with each other: only the way between the places contradicts them."""
    walls, way = twin_corridors()
    tracking = tracked(log_of(walls, way, beams=240))
    truth = in_first(way)[tracking.keys]
    for turn in (0.0, 0.002):
        drifted = bent(tracking, turn)
        found = close_loops(drifted, SIGMA, silent)
        assert len(found.refused.first) >= 3
        assert wrong(found.refused, truth).min() > 2.0
        assert np.all(wrong(found.closures, truth) < 0.2)
        np.testing.assert_allclose(found.poses, drifted.poses[tracking.keys], atol=0.02)


def look(poses: np.ndarray) -> Search:
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    return Search([], poses, way, 0.03, np.arange(len(poses)), Views(log_of(room(), poses[:1]).horizontal))


def edges(*found: tuple[int, int, tuple[float, float, float]]) -> Edges:
    first, second, relative = zip(*found, strict=True)
    m = len(found)
    information = np.tile(np.diag([1e4, 1e4, 1e5]), (m, 1, 1))
    return Edges(np.array(first), np.array(second), np.array(relative, float), information, np.ones(m, bool))


def test_bold_closures_need_another_one_that_agrees():
    """Out for 20 m and back beside it: the poses say that key scan 40 lies at (0, 0.2) from the first."""
    way = np.concatenate([np.c_[np.arange(21), np.zeros((21, 2))], np.c_[np.arange(19, -1, -1), np.full((20, 1), 0.2),
                                                                         np.full((20, 1), np.pi)]])  # fmt: skip
    there = se2.between(way[0], way[40]), se2.between(way[2], way[38]), se2.between(way[10], way[30])
    shift = np.array([1.5, 0.3, 0.0])
    timid = edges((0, 40, tuple(there[0] + [0.2, 0.1, 0.0])))
    assert loops._supported(look(way), timid).tolist() == [True]
    alone = edges((0, 40, tuple(there[0] + shift)))
    assert loops._supported(look(way), alone).tolist() == [False]
    agreeing = edges((0, 40, tuple(there[0] + shift)), (2, 38, tuple(there[1] + shift)))
    assert loops._supported(look(way), agreeing).tolist() == [True, True]
    against = edges((0, 40, tuple(there[0] + shift)), (2, 38, tuple(there[1] - shift)))
    assert loops._supported(look(way), against).tolist() == [False, False]
    far_off = edges((0, 40, tuple(there[0] + shift)), (10, 30, tuple(there[2] + shift)))
    assert loops._supported(look(way), far_off).tolist() == [True, True] if loops.SUPPORT_WAY > 10 else [False, False]


def test_wide_searches_go_where_the_graph_leaves_places_far_apart():
    """Out for 70 m and back 3 m beside it: the farther from the turn, the less is known of how the ways lie."""
    back = np.column_stack([np.arange(69.0, -1, -1), np.full(70, 3.0), np.full(70, np.pi)])
    way = np.concatenate([np.column_stack([np.arange(71.0), np.zeros((71, 2))]), back])
    n = len(way)
    steps = [(k, k + 1, tuple(se2.between(way[k], way[k + 1]))) for k in range(n - 1)]
    sure = np.zeros(n + 1, bool)
    far = list(far_candidates(look(way), 3.0, edges(*steps)._replace(robust=sure[: n - 1])))
    assert all(before == n - 1 - here for here, before, _ in far)
    assert all(reach > 2.0 for _, _, reach in far)
    closed = [*steps, (0, n - 1, tuple(se2.between(way[0], way[-1]))), (30, 110, tuple(se2.between(way[30], way[110])))]
    far = list(far_candidates(look(way), 3.0, edges(*closed)._replace(robust=sure)))
    assert far, "between the two closures and the turn nothing holds"
    assert {here for here, _, _ in far} <= set(range(70, 101)) | set(range(120, 131))


def test_closure_that_stands_alone_finds_the_others_that_bear_it_out(lap):
    """Drifted so far that the place is no candidate: a true closure leads to its neighbours, a false one to none."""
    tracking, truth = lap
    drifted = bent(tracking, 0.005)
    seen = look(drifted.poses[drifted.keys])._replace(points=tracking.points, keys=tracking.keys, views=tracking.views)
    last = len(truth) - 5
    first = int(np.argmin(np.hypot(*(truth[: last // 2] - truth[last])[:, :2].T)))
    assert np.hypot(*(seen.poses[first] - seen.poses[last])[:2]) > 3.0, "the drift hides the place"
    there = se2.between(truth[first], truth[last])
    true = edges((first, last, tuple(there)))
    found = witnesses(seen, true)
    assert len(found.first) >= FEWEST_WITNESSES
    assert wrong(found, truth).max() < 0.1
    assert loops._supported(seen, Edges(*map(np.concatenate, zip(true, found, strict=True)))).all()
    false = edges((first, last, tuple(there + np.array([1.5, 1.0, 0.3]))))
    assert len(witnesses(seen, false).first) == 0


def test_false_closure_among_true_ones_is_refused_and_reported(lap, monkeypatch):
    tracking, truth = lap
    last = len(truth) - 4
    false = edges((last // 2, last, (0.0, 0.0, 0.0)))
    find, given = loops._find, []

    def with_a_false_one(*args, **kwargs) -> Edges:
        found = find(*args, **kwargs)
        if given:
            return found
        given.append(True)
        return Edges(*(np.concatenate(fields) for fields in zip(found, false, strict=True)))

    monkeypatch.setattr(loops, "_find", with_a_false_one)
    monkeypatch.setattr(loops, "_supported", lambda _, found: np.ones(len(found.first), bool))
    found = close_loops(tracking, SIGMA, silent)
    assert (last // 2, last) in set(zip(found.refused.first.tolist(), found.refused.second.tolist(), strict=True))
    assert wrong(found.closures, truth).max() < 0.1
    assert place_errors(found.poses, truth).max() < 0.15


def test_closure_that_nothing_supports_is_reported_as_refused(lap, monkeypatch):
    tracking, _ = lap
    monkeypatch.setattr(loops, "_supported", lambda _, found: np.zeros(len(found.first), bool))
    found = close_loops(tracking, SIGMA, silent)
    assert len(found.closures.first) == 0
    pairs = list(zip(found.refused.first.tolist(), found.refused.second.tolist(), strict=True))
    assert len(pairs) == len(set(pairs)) > 0


def test_map_tells_its_loops_by_scans_and_how_it_was_tracked():
    log = log_of(ring(), ROUND, beams=180)
    slam = run_slam(log, SlamParams())
    closures = slam.closures
    assert closures.held.sum() >= 3
    truth = in_first(ROUND)
    measured = se2.between(truth[closures.first], truth[closures.second])
    away = np.hypot(*se2.between(measured, closures.relative)[:, :2].T)
    assert away[closures.held].max() < 0.1
    assert slam.tracked_poses.shape == slam.trajectory.poses.shape
    assert not np.array_equal(slam.tracked_poses, slam.trajectory.poses)
    paper = run_slam(log_of(ring(), ROUND[:30], beams=180), SlamParams(method="paper"))
    assert paper.tracked_poses is None
    assert len(paper.closures.first) == 0


def corridor_points(doors: bool, seed: int) -> OrientedPoints:
    """Two walls along x, 2 m apart, their normals off by 0.03 rad; with doors, a few points that face along x too."""
    rng = np.random.default_rng(seed)
    x = np.tile(np.arange(-6.0, 6.0, 0.1), 2)
    side = np.repeat([-1.0, 1.0], len(x) // 2)
    direction = -np.pi / 2 * side + 0.03 * rng.normal(size=len(x))
    xy = np.column_stack([x, side]) + SIGMA * rng.normal(size=(len(x), 2)) * [0, 1]
    if doors:
        at = np.repeat([-3.0, 1.0, 2.0], 4)
        frames = np.column_stack([at + SIGMA * rng.normal(size=12), np.tile([1.05, 1.1, 1.15, 1.2], 3)])
        xy, direction = np.vstack([xy, frames]), np.concatenate([direction, np.zeros(12)])
    return OrientedPoints(xy, np.column_stack([np.cos(direction), np.sin(direction)]))


def test_bare_corridor_tells_nothing_of_the_place_along_it():
    """Though the normals scatter, and however many of its points match; what crosses the walls is known as before."""
    along_x = []
    for seed in range(10):
        source, target = corridor_points(False, seed), make_target(corridor_points(False, seed + 100))
        found = register(source, target, np.array([0.5, 0.0, 0.0]), 0.03, 0.0, 0.0)
        assert found is not None
        along_x.append(found.information[0, 0])
        assert found.information[1, 1] > 0.7 * len(source.xy) / 0.03**2
        assert found.information[2, 2] > 0.7 * (source.xy[:, 0] ** 2).sum() / 0.03**2
    assert max(along_x) < 1 / 0.1**2
    assert np.median(along_x) < 1 / 0.5**2


def test_doors_tell_the_place_along_a_corridor():
    source, target = corridor_points(True, 0), make_target(corridor_points(True, 100))
    found = register(source, target, np.array([0.02, 0.0, 0.0]), 0.03, 0.0, 0.0)
    assert found is not None
    assert 1 / 0.03**2 < found.information[0, 0] < 13 / 0.03**2
    assert found.pose == pytest.approx(0.0, abs=0.01)


def test_corridor_that_looks_like_another_is_refused_by_what_stands_in_its_doorways():
    """Two straight corridors alike but for a room behind the doorway of the one and a closed one in the other."""
    walls = polygon((-1, -1), (21, -1), (21, 1), (11, 1), (11, 4), (9, 4), (9, 1), (-1, 1))
    others = polygon((-1, -1), (21, -1), (21, 1), (11, 1), (11, 1.3), (9, 1.3), (9, 1), (-1, 1))
    way = along([(0, 0), (20, 0)], 0.2)
    once, again, elsewhere = (log_of(world, way, seed) for seed, world in enumerate((walls, walls, others)))
    for second, held in ((again, True), (elsewhere, False)):
        scans = once.horizontal
        ranges = np.concatenate([scans.ranges, second.horizontal.ranges])
        both = replace(scans, ranges=ranges, time_ns=np.arange(len(ranges)) * 10**8)
        first = track_scans(once, SIGMA, SlamParams(), silent)
        back = track_scans(second, SIGMA, SlamParams(), silent)
        poses = np.concatenate([first.poses[first.keys], back.poses[back.keys] + [0.6, 0.0, 0.0]])
        keys = np.concatenate([first.keys, back.keys + len(way)])
        seen = Search([*first.points, *back.points], poses, np.arange(len(poses)), 0.03, keys, Views(both))
        here, there = len(first.keys) // 2, len(first.keys) + len(back.keys) // 2
        guess = se2.between(poses[here], poses[there])
        found = revisit(seen, target_map(seen, here), here, there, guess, 3.0, 0.5)
        assert (found is not None) == held
