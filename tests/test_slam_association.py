"""Data association: what may never match, joint compatibility, PCA against the full branch and bound."""

import numpy as np
import pytest

from bsmap_cli.core.gaussian import chi2_gate
from bsmap_cli.params import SlamParams
from bsmap_cli.slam import filter
from bsmap_cli.slam.association import Candidates, best_joint_match, find_candidates, partial_compatibility
from bsmap_cli.slam.segments import Segments

DEFAULT = SlamParams()
GATE, MARGIN = DEFAULT.gate, DEFAULT.overlap_margin


def line_through(a: np.ndarray, b: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(2,) alpha, r and (2,) extent of the segment from a to b, n pointing away from `eye`."""
    t = (b - a) / np.linalg.norm(b - a)
    n = np.array([t[1], -t[0]])
    if n @ (a - eye) < 0:
        n = -n
    t = np.array([-n[1], n[0]])
    return np.array([np.arctan2(n[1], n[0]), n @ a]), np.sort([t @ a, t @ b])


class World:
    """Walls in the map, as the filter knows them after having seen each once from (0, 0, 0)."""

    def __init__(self, walls: list, pose_sigma: tuple = (0.02, 0.02, 0.01), eye: tuple = (0.0, 0.0)):
        self.walls = [np.array(w, float) for w in walls]
        self.state = filter.initial_state()
        extents = []
        for a, b in self.walls:
            line, extent = line_through(a, b, np.array(eye))
            self.state = filter.augment(self.state, line, np.diag([0.002, 0.005]) ** 2)
            extents.append(extent)
        self.extents = np.array(extents)
        self.state = filter.predict(self.state, np.zeros(3), np.diag(pose_sigma) ** 2)

    def seen(self, pose: np.ndarray, walls: list[int] | None = None, noise: float = 0.0, seed: int = 0) -> Segments:
        """Segments of walls as a robot at the true pose sees them, in order of bearing."""
        rng = np.random.default_rng(seed)
        lines, extents, bearings = [], [], []
        c, s = np.cos(pose[2]), np.sin(pose[2])
        for k in range(len(self.walls)) if walls is None else walls:
            local = (self.walls[k] - pose[:2]) @ np.array([[c, -s], [s, c]])
            line, extent = line_through(*local, np.zeros(2))
            lines.append(line + noise * rng.normal(size=2) * [0.002, 0.005])
            extents.append(extent)
            bearings.append(np.arctan2(*local.mean(axis=0)[::-1]))
        order = np.argsort(bearings)
        self.order = order if walls is None else np.array(walls)[order]
        count = len(lines)
        covariance = np.tile(np.diag([0.002, 0.005]) ** 2, (count, 1, 1))
        none, extents = np.zeros((count, 2)), np.array(extents)[order]
        return Segments(np.zeros(count, int), np.array(lines)[order], covariance, extents, np.full(count, 50), none)

    def candidates(self, segments: Segments, margin: float = MARGIN) -> Candidates:
        return find_candidates(self.state, self.extents, segments, GATE, margin)


def room_with_niches(seed: int) -> list:
    """Walls of a room and faces of several niches and pillars, all some decimetres apart."""
    rng = np.random.default_rng(seed)
    walls = [((-4, -3), (5, -3)), ((5, -3), (5, 3)), ((5, 3), (-4, 3)), ((-4, 3), (-4, -3))]
    for x in np.arange(-3, 4, 1.5) + rng.uniform(-0.2, 0.2):
        depth = rng.uniform(0.3, 0.6)
        walls += [
            ((x, 3 - depth), (x + 0.7, 3 - depth)),
            ((x, 3 - depth), (x, 3)),
            ((x + 0.7, 3 - depth), (x + 0.7, 3)),
        ]
    return walls


def pairs_of(candidates: Candidates, chosen: list[int]) -> set[tuple[int, int]]:
    return {(int(candidates.segment[c]), int(candidates.line[c])) for c in chosen}


def match(candidates: Candidates, count: int, group: int = DEFAULT.group_size) -> list[int]:
    return partial_compatibility(candidates, range(count), group, GATE)


def test_walls_seen_again_match_themselves():
    world = World(room_with_niches(0), (0.03, 0.03, 0.02))
    segments = world.seen(np.array([0.04, -0.03, 0.02]), noise=1.0)
    candidates = world.candidates(segments)
    assert pairs_of(candidates, match(candidates, len(segments.scan))) == set(enumerate(world.order.tolist()))


def test_two_faces_of_a_thin_wall_never_match():
    """The robot comes to the other side of a wall of 5 cm: equal but for the side, and unsure where it is."""
    world = World([((2.0, -2), (2.0, 2))], (0.3, 0.3, 0.1))
    assert len(world.candidates(world.seen(np.zeros(3))).segment) == 1
    back = World([((2.05, -2), (2.05, 2))]).seen(np.array([4.0, 0.0, 0.0]))
    world.state = filter.predict(world.state, np.array([4.0, 0, 0]), np.diag([0.3, 0.3, 0.1]) ** 2)
    assert len(world.candidates(back).segment) == 0


def test_equal_lines_of_disjoint_extents_never_match():
    """One straight line (alpha, r) with walls in two rooms on it."""
    world = World([((2.0, -6), (2.0, -3)), ((2.0, 3), (2.0, 6))])
    np.testing.assert_allclose(world.state.lines[0], world.state.lines[1], atol=1e-12)
    candidates = world.candidates(world.seen(np.zeros(3), [0]))
    assert pairs_of(candidates, range(len(candidates.segment))) == {(0, 0)}
    middle = World([((2.0, -1.5), (2.0, 1.5))]).seen(np.zeros(3))
    assert len(world.candidates(middle, margin=1.4).segment) == 0
    assert len(world.candidates(middle, margin=1.6).segment) == 2


def test_extents_are_compared_in_one_frame_wherever_the_robot_is():
    walls = [((30.0, 40.0), (30.0, 43.0)), ((30.0, 46.0), (30.0, 49.0))]
    world = World(walls, eye=(28.0, 44.0))
    for pose in np.array([[28.0, 41.0, 1.0], [27.0, 47.0, -2.5]]):
        world.state.mean[:3] = pose
        segments = world.seen(pose)
        candidates = world.candidates(segments)
        assert pairs_of(candidates, range(len(candidates.segment))) == set(enumerate(world.order.tolist()))


def test_candidate_covariance_is_that_of_the_stacked_innovation():
    """By the full Jacobian of all candidates; correlations through the pose included."""
    world = World(room_with_niches(1), (0.1, 0.1, 0.05))
    segments = world.seen(np.array([0.1, 0.1, 0.05]))
    candidates = world.candidates(segments)
    P = filter.gather(world.state.covariance, np.arange(world.state.size))
    H, R, v = [], np.zeros((2 * len(candidates.line),) * 2), []
    for k, (segment, line) in enumerate(zip(candidates.segment, candidates.line, strict=True)):
        row = np.zeros((2, len(P)))
        row[:, :3], row[:, 3 + 2 * line : 5 + 2 * line] = filter.line_jacobians(
            world.state.pose, world.state.lines[line, 0]
        )
        H.append(row)
        R[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = segments.covariances[segment]
        expected = filter.expected_lines(world.state.pose, world.state.lines[line : line + 1])[0]
        v.append(segments.parameters[segment] - expected)
    H = np.concatenate(H)
    np.testing.assert_allclose(candidates.covariance, H @ P @ H.T + R, atol=1e-15)
    turns = (np.concatenate(v) - candidates.innovation)[::2] / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-9)
    S = candidates.covariance
    blocks = [S[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(candidates.line))]
    wanted = [x @ np.linalg.solve(B, x) for x, B in zip(candidates.innovation.reshape(-1, 2), blocks, strict=True)]
    np.testing.assert_allclose(candidates.distance, wanted, rtol=1e-9)
    assert max(wanted) <= chi2_gate(GATE, 2)


def test_candidates_of_a_segment_come_nearest_first():
    world = World(room_with_niches(2), (0.3, 0.3, 0.1))
    candidates = world.candidates(world.seen(np.zeros(3)))
    for pairs in candidates.of_segment().values():
        assert np.all(np.diff(candidates.distance[pairs]) >= 0)
    assert np.all(np.diff(candidates.segment) >= 0)


@pytest.mark.parametrize("seed", range(8))
def test_pca_decides_as_full_jcbb_on_unambiguous_scenes(seed):
    rng = np.random.default_rng(seed)
    world = World(room_with_niches(seed), (0.05, 0.05, 0.02))
    segments = world.seen(rng.normal(size=3) * [0.05, 0.05, 0.02], noise=0.5, seed=seed)
    candidates = world.candidates(segments)
    count = len(segments.scan)
    full = best_joint_match(candidates, range(count), GATE)
    for group in (1, 3, 4, 8):
        assert pairs_of(candidates, match(candidates, count, group)) == pairs_of(candidates, full)


@pytest.mark.parametrize("seed", range(12))
def test_result_is_jointly_compatible_and_holds_each_segment_once(seed):
    """Also where the pose is so unsure that wrong candidates abound."""
    rng = np.random.default_rng(seed)
    world = World(room_with_niches(seed), (0.5, 0.5, 0.2))
    segments = world.seen(rng.normal(size=3) * [0.5, 0.5, 0.2], noise=2.0, seed=seed)
    candidates = world.candidates(segments)
    chosen = match(candidates, len(segments.scan))
    assert bool(chosen) == (len(candidates.segment) > 0)
    assert not chosen or candidates.joint_distance(chosen) <= chi2_gate(GATE, 2 * len(chosen))
    taken = candidates.segment[chosen]
    assert len(set(taken.tolist())) == len(taken)


def test_joint_compatibility_sees_what_single_pairs_cannot():
    """All walls moved one way fit one pose; two opposite walls that moved apart fit none, though each alone does."""
    world = World([((3.0, -2), (3.0, 2)), ((-3.0, -2), (-3.0, 2))], (0.2, 0.2, 0.01))
    moved = world.seen(np.array([0.25, 0.0, 0.0]))
    assert len(match(world.candidates(moved), 2)) == 2
    apart = World([((3.25, -2), (3.25, 2)), ((-3.25, -2), (-3.25, 2))]).seen(np.zeros(3))
    candidates = world.candidates(apart)
    assert len(candidates.segment) == 2
    assert len(match(candidates, 2)) == 1


def test_wrong_nearest_candidates_are_refused():
    """A row of steps seen 0.2 m shifted, where the next step lies 0.1 m off: the other walls tell the shift."""
    steps = [((2.0 + 0.3 * k, k - 3.0), (2.0 + 0.3 * k, k - 2.2)) for k in range(6)]
    world = World([*steps, ((-3, -5), (5, -5)), ((-3, -5), (-3, 4))], (0.25, 0.02, 0.005))
    segments = world.seen(np.array([0.2, 0.0, 0.0]), noise=0.5)
    candidates = world.candidates(segments)
    truth = set(enumerate(world.order.tolist()))
    nearest = pairs_of(candidates, [pairs[0] for pairs in candidates.of_segment().values()])
    assert len(nearest - truth) >= 4
    found = pairs_of(candidates, match(candidates, len(segments.scan)))
    assert found <= truth
    assert len(found) >= 3


def test_branch_and_bound_finds_the_largest_hypothesis_of_all():
    """Against trying every hypothesis."""
    from itertools import product

    for seed in range(5):
        rng = np.random.default_rng(seed)
        world = World(room_with_niches(seed)[:9], (0.4, 0.4, 0.1))
        segments = world.seen(rng.normal(size=3) * [0.4, 0.4, 0.1], list(range(5)), noise=2.0, seed=seed)
        candidates = world.candidates(segments)
        options = [[None, *candidates.of_segment().get(k, [])] for k in range(5)]
        best = (0, 0.0)
        for choice in product(*options):
            pairs = [c for c in choice if c is not None]
            if pairs and (d := candidates.joint_distance(pairs)) <= chi2_gate(GATE, 2 * len(pairs)):
                best = min(best, (-len(pairs), d))
        chosen = best_joint_match(candidates, range(5), GATE)
        assert -len(chosen) == best[0]
        assert candidates.joint_distance(chosen) == pytest.approx(best[1])


def test_nothing_to_match_gives_nothing():
    world = World([((2.0, -2), (2.0, 2))])
    none = world.seen(np.zeros(3), [0])
    none = Segments(*(field[:0] for field in none))
    assert match(world.candidates(none), 0) == []
    empty = find_candidates(filter.initial_state(), np.zeros((0, 2)), world.seen(np.zeros(3)), GATE, MARGIN)
    assert match(empty, 1) == []
