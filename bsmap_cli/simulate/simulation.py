"""Scene -> log and truth."""

from dataclasses import dataclass

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.errors import ParameterError
from bsmap_cli.model import Array, IntArray, LaserScans, ScanLog, Trajectory
from bsmap_cli.params import SimulateParams
from bsmap_cli.simulate import robot
from bsmap_cli.simulate.path import Path, poses_at
from bsmap_cli.simulate.raycast import Caster
from bsmap_cli.simulate.robot import Laser
from bsmap_cli.simulate.scenes import SCENES, Scene
from bsmap_cli.track import Track, silent

EPOCH_NS = 1_700_000_000_000_000_000  # the simulated clock starts here
TRUTH_RATE = 50.0  # Hz
RAYS_AT_ONCE = 200_000


@dataclass(frozen=True)
class Simulation:
    """A simulated log and the truth behind it.

    log : what the robot recorded; log.odometry is the odometry below, interpolated to the horizontal scans.
    odometry_time_ns, odometry_poses : (k,), (k, 3), the odometry's own messages, in the odometry frame.
    truth : poses of base_link in the scene frame, at 50 Hz and at the stamp of every scan; covariances are zero.
    vertices, triangles : (n, 3) m in the scene frame, (m, 3): the scene's mesh.
    """

    log: ScanLog
    odometry_time_ns: IntArray
    odometry_poses: Array
    truth: Trajectory
    vertices: Array
    triangles: IntArray


def simulate_scene(scene: str, params: SimulateParams, *, track: Track = silent) -> Simulation:
    """Drive the robot through a scene. The same scene and parameters give the same bytes.

    Raises ParameterError for a scene that is not in SCENES.
    """
    if scene not in SCENES:
        raise ParameterError(f"scene {scene!r} is not one of {', '.join(SCENES)}")
    made = SCENES[scene]()
    for_odometry, for_horizontal, for_vertical = np.random.default_rng(params.seed).spawn(3)
    caster = Caster(made.mesh)
    horizontal = scan(robot.HORIZONTAL, made, caster, params, for_horizontal, track)
    vertical = scan(robot.VERTICAL, made, caster, params, for_vertical, track)
    time_ns = _ticks(made.path, robot.ODOMETRY_RATE)
    poses = robot.odometry(made.path, _seconds(time_ns), params.odometry_error, for_odometry)
    log = ScanLog(horizontal, se2.interpolate(time_ns, poses, horizontal.time_ns), vertical)
    truth = _truth(made.path, horizontal.time_ns, vertical.time_ns)
    return Simulation(log, time_ns, poses, truth, made.mesh.vertices, made.mesh.triangles)


def scan(
    laser: Laser, scene: Scene, caster: Caster, params: SimulateParams, rng: np.random.Generator, track: Track = silent
) -> LaserScans:
    """All scans of one laser along the scene's path."""
    time_ns = scan_stamps(laser, scene, params.rate)
    time_increment = _time_increment(laser, params.rate) if scene.scan_times is None else 0.0
    times = _seconds(time_ns)[:, None] + time_increment * np.arange(laser.beams)
    ranges = np.empty(times.shape)
    step = max(1, RAYS_AT_ONCE // laser.beams)
    for first in range(0, len(times), step):
        track(f"scans of {laser.name}", first, len(times))
        part = slice(first, first + step)
        ranges[part] = caster.distances(*robot.beam_rays(laser, scene.path, times[part]))
    track(f"scans of {laser.name}", len(times), len(times))
    ranges += params.range_sigma * rng.standard_normal(ranges.shape)
    ranges[(ranges < robot.RANGE_MIN) | (ranges > robot.RANGE_MAX)] = np.nan
    return LaserScans(
        time_ns=time_ns,
        ranges=ranges.astype(np.float32),
        angle_min=laser.angle_min,
        angle_increment=laser.angle_increment,
        time_increment=time_increment,
        range_min=float(np.float32(robot.RANGE_MIN)),
        range_max=robot.RANGE_MAX,
        mount=laser.mount,
        frame_id=laser.name,
        topic=f"/{laser.name}/scan",
    )


def scan_stamps(laser: Laser, scene: Scene, rate: float) -> IntArray:
    """Stamps (n,) ns: at a rate (Hz), each laser with its own delay; both at once where a stepwise robot stands."""
    if scene.scan_times is not None:
        return EPOCH_NS + np.rint(scene.scan_times * 1e9).astype(np.int64)
    ticks = _ticks(scene.path, rate) + round(laser.delay * 1e9)
    return ticks[ticks < EPOCH_NS + round((scene.path.time[-1] - robot.SCAN_TIME) * 1e9)]


def _time_increment(laser: Laser, rate: float) -> float:
    return float(np.float32(min(robot.SCAN_TIME, 1 / rate) / laser.beams))


def _truth(path: Path, *stamps: IntArray) -> Trajectory:
    time_ns = np.unique(np.concatenate([_ticks(path, TRUTH_RATE), *stamps]))
    return Trajectory(time_ns, poses_at(path, _seconds(time_ns)), np.zeros((len(time_ns), 3, 3)))


def _ticks(path: Path, rate: float) -> IntArray:
    """Stamps (n,) ns at a rate (Hz) from the path's begin to the first at or after its end."""
    count = int(np.ceil(path.time[-1] * rate)) + 1
    return EPOCH_NS + np.rint(np.arange(count) / rate * 1e9).astype(np.int64)


def _seconds(time_ns: IntArray) -> Array:
    """Seconds (n,) on the path's clock."""
    return np.asarray((time_ns - EPOCH_NS) * 1e-9, dtype=np.float64)
