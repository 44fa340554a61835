"""Delay between laser and odometry: found where it is, never invented, and taken out."""

from dataclasses import replace

import numpy as np
import pytest

from bsmap_cli.evaluate import align
from bsmap_cli.params import SimulateParams, SlamParams
from bsmap_cli.simulate import simulate_scene
from bsmap_cli.slam import run_slam
from bsmap_cli.slam.latency import lined_up, odometry_delay


def winding(delay: float, n: int = 400, noise: float = 0.002) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps at 10 Hz, poses of a robot that winds along, and odometry that tells at each what comes `delay` later."""
    rng = np.random.default_rng(0)
    seconds = 0.1 * np.arange(n)
    poses, odometry = np.zeros((n, 3)), np.zeros((n, 3))
    poses[:, 2], odometry[:, 2] = (0.8 * np.sin(0.9 * t) + 0.5 * np.sin(0.37 * t) for t in (seconds, seconds + delay))
    odometry += np.cumsum(rng.normal(0.0, noise, (n, 3)), axis=0)
    return np.rint(seconds * 1e9).astype(np.int64), poses, odometry


@pytest.mark.parametrize("delay", [-0.3, -0.1, 0.16, 0.4])
def test_delay_is_found_to_a_hundredth_of_a_second(delay):
    assert odometry_delay(*winding(delay), np.ones(400, bool)) == pytest.approx(delay, abs=0.015)


@pytest.mark.parametrize("noise", [0.002, 0.02, 0.05])
def test_stamps_that_agree_have_no_delay(noise):
    """Poor odometry agrees better where it is interpolated, half-way between its stamps: that is no delay."""
    assert odometry_delay(*winding(0.0, noise=noise), np.ones(400, bool)) == 0.0


@pytest.mark.parametrize("case", ["few", "straight", "stamps step back", "nothing alike", "scans far apart"])
def test_nothing_is_told_where_nothing_can_be(case):
    time_ns, poses, odometry = winding(0.2)
    matched = np.ones(400, bool)
    if case == "few":
        matched[100:] = False
    elif case == "straight":
        poses, odometry = poses * [1, 1, 0], odometry * [1, 1, 0]
    elif case == "stamps step back":
        time_ns[200] = time_ns[198]
    elif case == "scans far apart":
        time_ns = 10 * time_ns
    else:
        poses = np.random.default_rng(1).normal(size=poses.shape)
    assert odometry_delay(time_ns, poses, odometry, matched) == 0.0


def test_log_with_a_delay_is_tracked_as_one_without_and_the_user_is_told(caplog):
    made = simulate_scene("corridor", SimulateParams(seed=3))
    plain = replace(made.log, vertical=None)
    late = lined_up(plain, -0.2)  # the odometry tells at each stamp what the laser shows 0.2 s later
    found = run_slam(late, SlamParams())
    assert (
        align(found.trajectory, made.truth).rms < 1.5 * align(run_slam(plain, SlamParams()).trajectory, made.truth).rms
    )
    assert caplog.text.count("behind those of the odometry; lined up") == 1
