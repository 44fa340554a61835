from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from parallel_pairs import PAIRS
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.core import se2
from bsmap_cli.errors import ParameterError
from bsmap_cli.evaluate import transform_points
from bsmap_cli.params import CloudParams, SimulateParams
from bsmap_cli.simulate import SCENES, robot, simulate_scene
from bsmap_cli.simulate.geometry import carve, room
from bsmap_cli.simulate.path import integrate, poses_at
from bsmap_cli.simulate.raycast import Caster
from bsmap_cli.simulate.scenes import Scene
from bsmap_cli.simulate.simulation import scan


def content(value):
    """Everything in a dataclass, as bytes."""
    if is_dataclass(value):
        return b"".join(content(getattr(value, f.name)) for f in fields(value))
    return value.tobytes() if isinstance(value, np.ndarray) else repr(value).encode()


def box_ranges(laser, pose, size):
    """Ranges (m,) in an empty box from the origin to `size`, by slabs."""
    path = integrate(pose, np.array([1.0]), np.zeros((1, 2)))
    origins, directions = robot.beam_rays(laser, path, np.zeros((1, laser.beams)))
    with np.errstate(divide="ignore"):
        return np.max([-origins / directions, (size - origins) / directions], axis=0).min(axis=-1)[0]


@pytest.mark.parametrize("laser", [robot.HORIZONTAL, robot.VERTICAL])
def test_ranges_in_a_box_are_those_of_geometry(laser):
    size, pose = np.array([6.0, 4.0, 3.0]), (2.0, 1.5, 0.4)
    path = integrate(pose, np.array([1.0]), np.zeros((1, 2)))
    scene = Scene(carve([room(0, 6, 0, 4, 0, 3)]), path, np.array([0.5]))
    scans = scan(laser, scene, Caster(scene.mesh), SimulateParams(range_sigma=0.0), np.random.default_rng(0))
    assert scans.ranges.dtype == np.float32
    np.testing.assert_allclose(scans.ranges[0], box_ranges(laser, pose, size), atol=2e-6)


def test_nothing_within_thirty_metres_is_no_return():
    path = integrate((1.0, 1.0, 0.0), np.array([1.0]), np.zeros((1, 2)))
    scene = Scene(carve([room(0, 40, 0, 2, 0, 2)]), path, np.array([0.5]))
    params = SimulateParams(range_sigma=0.0)
    ranges = scan(robot.HORIZONTAL, scene, Caster(scene.mesh), params, np.random.default_rng(0)).ranges
    straight_on = robot.HORIZONTAL.beams // 2
    assert np.isnan(ranges[0, straight_on])
    assert 20 < np.nanmax(ranges) <= 30


def test_same_seed_gives_the_same_bytes_and_another_seed_does_not():
    params = SimulateParams(seed=3)
    first = content(simulate_scene("room", params))
    assert first == content(simulate_scene("room", params))
    assert first != content(simulated("room", seed=4))


def test_noise_along_the_beam_has_its_sigma():
    exact, noisy = simulated("room", range_sigma=0.0).log, simulated("room", range_sigma=0.02).log
    for laser in ("horizontal", "vertical"):
        noise = (getattr(noisy, laser).ranges - getattr(exact, laser).ranges).ravel()
        assert abs(noise.mean()) < 4 * 0.02 / np.sqrt(noise.size)
        assert abs(noise.std() / 0.02 - 1) < 4 / np.sqrt(2 * noise.size)
        assert abs(np.corrcoef(noise[:-1], noise[1:])[0, 1]) < 4 / np.sqrt(noise.size)


def test_room_has_seven_alternating_sets_of_steps():
    simulation = simulated("room")
    truth = simulation.truth
    poses = truth.poses[np.searchsorted(truth.time_ns, simulation.log.horizontal.time_ns)]
    step = se2.between(poses[:-1], poses[1:])
    way = np.hypot(step[:, 0], step[:, 1])
    turning = way < 1e-9
    np.testing.assert_allclose(way[~turning], 0.1, atol=1e-9)
    np.testing.assert_allclose(step[turning, 2], 0.087, atol=1e-9)
    assert np.count_nonzero(np.diff(turning)) == 6
    assert simulation.log.horizontal.time_increment == simulation.log.vertical.time_increment == 0.0


def test_beams_of_a_moving_robot_have_their_own_times():
    path = integrate((1.0, 1.0, 0.0), np.array([2.0]), np.array([[0.5, 0.0]]))
    scene = Scene(carve([room(0, 6, 0, 2, 0, 3)]), path)
    params = SimulateParams(range_sigma=0.0, rate=10.0)
    scans = scan(robot.HORIZONTAL, scene, Caster(scene.mesh), params, np.random.default_rng(0))
    ahead = robot.HORIZONTAL.beams // 2
    np.testing.assert_allclose(np.diff(scans.time_ns), 100_000_000)
    np.testing.assert_allclose(scans.time_increment * 760, 0.025, rtol=1e-6)
    times = (scans.time_ns - scans.time_ns[0]) * 1e-9 + scans.time_increment * ahead
    distance = (5.0 - 0.1 - 0.5 * times) / np.cos(scans.angles[ahead])
    np.testing.assert_allclose(scans.ranges[:, ahead], distance, atol=2e-6)


@pytest.mark.parametrize("name", SCENES)
def test_path_keeps_clear_of_everything(name):
    scene = SCENES[name]()
    x, y, _ = poses_at(scene.path, np.arange(0.0, scene.path.time[-1], 0.2)).T
    around = np.arange(72) * 2 * np.pi / 72
    directions = np.column_stack([np.cos(around), np.sin(around), np.zeros(72)])
    caster = Caster(scene.mesh)
    for z in (0.05, 0.35, 0.6, 1.0):
        origins = np.column_stack([x, y, np.full(len(x), z)])
        distances = caster.distances(*np.broadcast_arrays(origins[:, None], directions))
        assert distances.min() > 0.5


@pytest.mark.parametrize("name", ["corridor", "loop", "walls", "steps"])
def test_speeds_are_those_of_an_indoor_robot(name):
    path = SCENES[name]().path
    assert path.twists[:, 0].max() <= 0.6 + 1e-9
    assert np.abs(path.twists[:, 1]).max() < 1.0


def test_office_is_a_kilometre_of_loops():
    path = SCENES["office"]().path
    assert 950 < np.sum(np.diff(path.time) * path.twists[:, 0]) < 1050
    assert path.twists[:, 0].max() <= 0.7 + 1e-9


def test_loop_is_about_a_hundred_metres_and_closes():
    path = SCENES["loop"]().path
    way = np.sum(np.diff(path.time) * path.twists[:, 0])
    assert 95 < way < 110
    start, end = path.poses[0], path.poses[-1]
    assert np.isclose(end[2] - start[2], 2 * np.pi)
    assert np.isclose(end[1], start[1])
    assert 3 < end[0] - start[0] < 5


@pytest.mark.parametrize("name", [name for name in SCENES if name != "office"])  # that takes minutes
def test_log_agrees_with_its_odometry_and_truth(name):
    simulation = simulated(name, odometry_error=0.0)
    log, truth = simulation.log, simulation.truth
    assert np.all(np.isin(log.horizontal.time_ns, truth.time_ns))
    assert np.all(np.isin(log.vertical.time_ns, truth.time_ns))
    assert np.all(np.diff(truth.time_ns) > 0)
    assert simulation.odometry_time_ns[0] <= log.horizontal.time_ns[0]
    assert simulation.odometry_time_ns[-1] >= log.vertical.time_ns[-1]
    poses = truth.poses[np.searchsorted(truth.time_ns, log.horizontal.time_ns)]
    error = se2.between(se2.compose(truth.poses[0], log.odometry), poses)
    assert np.hypot(error[:, 0], error[:, 1]).max() < 1e-3  # interpolated between messages at 20 Hz
    assert not np.any(truth.covariances)
    for laser in (log.horizontal, log.vertical):
        assert np.isnan(laser.ranges).mean() < 0.01


@pytest.mark.parametrize("name", PAIRS)
def test_vertical_laser_sees_both_sides_of_what_lies_close_together(name):
    simulation = simulated(name, range_sigma=0.0)
    points = make_cloud(true_slam_map(simulation), CloudParams()).points
    start = np.searchsorted(simulation.truth.time_ns, simulation.log.horizontal.time_ns[0])
    points = transform_points(simulation.truth.poses[start], points)
    for pair in PAIRS[name]:
        for side in (pair.first, pair.second):
            others = np.delete(points, side.axis, axis=1)
            on = np.abs(points[:, side.axis] - side.level) < 0.004
            on &= np.all((others > side.low) & (others < side.high), axis=1)
            assert np.count_nonzero(on) > 1000, (pair.name, side)


def test_unknown_scene_names_the_scenes():
    with pytest.raises(ParameterError, match="'attic' is not one of room, corridor, loop, walls, steps"):
        simulate_scene("attic", SimulateParams())
