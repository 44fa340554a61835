"""Pictures: whatever a SlamMap holds or lacks can be drawn."""

from dataclasses import replace

import numpy as np
import pytest

from bsmap_cli.model import LineMap, LoopClosures, SlamMap, StepStatistics, Trajectory
from bsmap_cli.picture import draw_slam


def slam_map(n: int, m: int) -> SlamMap:
    rng = np.random.default_rng(n)
    counts = rng.integers(0, 9, (3, n))
    lines = LineMap(
        rng.uniform(0, 3, (m, 2)), np.tile(np.eye(2), (m, 1, 1)), np.sort(rng.normal(size=(m, 2))),
        rng.choice([-1, 1], m), rng.integers(1, 999, m),
    )  # fmt: skip
    poses = np.cumsum(rng.normal(size=(n, 3)), axis=0)
    trajectory = Trajectory(100_000_000 * np.arange(n), poses, np.tile(np.eye(3) * 1e-4, (n, 1, 1)))
    return SlamMap(trajectory, lines, StepStatistics(*counts, 2.0 * counts[2], 2 * counts[2]), None, np.eye(4))


def closures(m: int) -> LoopClosures:
    return LoopClosures(np.zeros(m, int), np.arange(m), np.zeros((m, 3)), np.arange(m) % 2 == 0)


@pytest.mark.parametrize(
    "slam",
    [
        slam_map(1, 0),
        slam_map(2, 1),
        slam_map(300, 40),
        replace(slam_map(50, 7), closures=closures(9), tracked_poses=np.zeros((50, 3))),
        replace(slam_map(50, 7), closures=closures(1)),
    ],
    ids=["one scan", "two scans", "no loops", "loops", "no loop refused"],
)
def test_every_map_can_be_drawn_and_twice_the_same(slam, tmp_path):
    for name in "ab":
        draw_slam(tmp_path / name, ".png", slam, "title")
    assert (tmp_path / "a").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_stamps_that_step_back_do_no_harm(tmp_path):
    slam = slam_map(30, 3)
    times = slam.trajectory.time_ns.copy()
    times[[4, 20]] = times[[20, 4]]
    draw_slam(tmp_path / "a", ".svg", replace(slam, trajectory=replace(slam.trajectory, time_ns=times)))
    assert (tmp_path / "a").stat().st_size > 10_000
