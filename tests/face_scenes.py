"""Data sets of known truth for the fit of faces: a corridor with recess, pillar and bowed wall; a real room."""

import gzip
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud
from bsmap_cli.core import se2
from bsmap_cli.evaluate import transform_points
from bsmap_cli.model import PointCloud, SlamMap, Trajectory
from bsmap_cli.params import CloudParams, SimulateParams
from bsmap_cli.simulate import robot
from bsmap_cli.simulate.geometry import Mesh, arc, carve, join, room, upright
from bsmap_cli.simulate.path import Path, poses_at, stepwise
from bsmap_cli.simulate.raycast import Caster
from bsmap_cli.simulate.scenes import Scene
from bsmap_cli.simulate.simulation import scan

REAL_ROOM = "/work/shared/data/scans/room_scan1.pcd.gz"


class Place(NamedTuple):
    """A cloud at true poses, and the truth: the scene's mesh, moved into map.

    clean : (n, 3) m, the cloud's points without noise.
    """

    cloud: PointCloud
    vertices: np.ndarray
    triangles: np.ndarray
    clean: np.ndarray


def corridor_mesh():
    """Corridor along x: a recess in the ceiling, half a pillar at one wall, the other wall bowed (radius 6 m)."""
    boxes = carve([room(-6.0, 8.0, -0.5, 2.2, 0.0, 2.6), room(0.55, 1.45, 0.6, 1.7, 2.6, 2.85)])
    half = np.arcsin(4.5 / 6.0)
    bowed = upright(arc((1.0, 5.7), 6.0, -np.pi / 2 + half, -np.pi / 2 - half), 0.0, 2.6)
    pillar = upright(arc((1.2, 2.2), 0.3, -np.pi, 0.0, np.radians(1.0)), 0.0, 2.6)
    return join([boxes, bowed, pillar])


def sheet(points):
    """Mesh through a grid of points (n, m, 3)."""
    n, m = points.shape[:2]
    first = (np.arange(n - 1)[:, None] * m + np.arange(m - 1)).ravel()
    triangles = np.concatenate([first[:, None] + [0, m, 1], first[:, None] + [1, m, m + 1]])
    return Mesh(points.reshape(-1, 3), triangles)


def arch(radius, height, start):
    """Vault along x, its axis at y = 1 and z = `height`, from the angle `start` below the level on both sides."""
    around, x = np.meshgrid(np.radians(np.arange(-start, 181 + start)), np.linspace(-6.0, 8.0, 15), indexing="ij")
    return sheet(np.stack([x, 1.0 + radius * np.cos(around), height + radius * np.sin(around)], axis=2))


def barrel_vault():
    """Corridor along x, 3.2 m wide, under a round vault."""
    box = carve([room(-6.0, 8.0, -0.6, 2.6, 0.0, 1.4)])
    level = np.all(box.vertices[box.triangles, 2] > 1.39, axis=1)
    return join([arch(1.6, 1.4, 0), Mesh(box.vertices, box.triangles[~level])])


def tunnel():
    """Round tunnel along x with a flat floor 1 m below its axis."""
    half = 2.0 * np.cos(np.radians(30.0))
    floor = carve([room(-6.0, 8.0, 1.0 - half, 1.0 + half, 0.0, 0.1)])
    level = np.all(floor.vertices[floor.triangles, 2] < 0.01, axis=1)
    return join([arch(2.0, 1.0, 30), Mesh(floor.vertices, floor.triangles[level])])


def half_ellipsoid(radii):
    """Half an ellipsoid with such half axes (3,) on a floor, its centre at (1, 1)."""
    around, up = np.meshgrid(np.radians(np.arange(361)), np.radians(np.linspace(0.0, 89.9, 181)), indexing="ij")
    level = np.cos(up)
    half = np.stack([level * np.cos(around), level * np.sin(around), np.sin(up)], axis=2)
    return join([sheet(half * radii + [1.0, 1.0, 0.0]), ground(4.0)])


def ground(half):
    """Level square about (1, 1)."""
    floor = carve([room(1.0 - half, 1.0 + half, 1.0 - half, 1.0 + half, 0.0, 0.1)])
    level = np.all(floor.vertices[floor.triangles, 2] < 0.01, axis=1)
    return Mesh(floor.vertices, floor.triangles[level])


def dome():
    """Half a sphere on a floor."""
    around, up = np.meshgrid(np.radians(np.arange(361)), np.radians(np.linspace(0.0, 89.9, 91)), indexing="ij")
    level = np.cos(up)
    half = sheet(3.0 * np.stack([level * np.cos(around), level * np.sin(around), np.sin(up)], axis=2) + [1.0, 1.0, 0.0])
    return join([half, ground(3.0)])


def egg():
    """A vault bent both ways, differently everywhere."""
    return half_ellipsoid((3.0, 2.0, 2.5))


def ring():
    """Tunnel of 2 m around a bend of 6 m, with a flat floor 1 m below its axis, which passes (1, 1)."""
    along, around = np.meshgrid(
        np.radians(np.linspace(-60.0, 60.0, 241)), np.radians(np.linspace(-30.0, 210.0, 241)), indexing="ij"
    )
    out = 6.0 + 2.0 * np.cos(around)
    tube = np.stack([1.0 + out * np.sin(along), out * np.cos(along) - 5.0, 1.0 + 2.0 * np.sin(around)], axis=2)
    return join([sheet(tube), ground(12.0)])


@cache
def caster():
    return Caster(corridor_mesh())


def corridor_set(sigma=0.01, seed=0, scans=20, beams=541):
    """A translation of 1.9 m in `scans` scans through the corridor."""
    return passing_set(corridor_mesh(), sigma, seed, scans, beams, caster())


def passing_set(mesh, sigma=0.01, seed=0, scans=20, beams=541, cast=None):
    """A translation of 1.9 m along x in `scans` scans."""
    cast = Caster(mesh) if cast is None else cast
    length = 1.9
    time = np.linspace(0.0, length, scans)
    path = Path(np.array([0.0, 3.0]), np.array([[0.0, 1.0, 0.0], [3.0, 1.0, 0.0]]), np.array([[1.0, 0.0]]))
    scene = Scene(mesh, path, time)
    laser = replace(robot.VERTICAL, beams=beams)
    noisy = scan(laser, scene, cast, SimulateParams(range_sigma=sigma), np.random.default_rng(seed))
    clean = scan(laser, scene, cast, SimulateParams(range_sigma=0.0), np.random.default_rng(seed))
    poses = np.column_stack([time, np.ones(scans), np.zeros(scans)])
    trajectory = Trajectory(noisy.time_ns, poses, np.zeros((scans, 3, 3)))
    slam_map = true_slam_map(simulated("room"))
    make = lambda scans: make_cloud(  # noqa: E731
        SlamMap(trajectory, slam_map.lines, slam_map.statistics, scans, slam_map.horizontal_mount), CloudParams()
    )
    return Place(make(noisy), mesh.vertices, mesh.triangles, make(clean).points)


def turning_set(mesh, start, steps=18, sigma=0.01, seed=0):
    """A turn on the spot in steps of 5 degrees from the pose `start`: its scans lie far apart in the distance."""
    path, times = stepwise(start, np.array([[0.0, 0.087]] * steps))
    scene, caster = Scene(mesh, path, times), Caster(mesh)
    noisy, clean = (
        scan(robot.VERTICAL, scene, caster, SimulateParams(range_sigma=s), np.random.default_rng(seed))
        for s in (sigma, 0.0)
    )
    trajectory = Trajectory(noisy.time_ns, poses_at(path, times), np.zeros((steps + 1, 3, 3)))
    known = true_slam_map(simulated("room"))
    clouds = [
        make_cloud(SlamMap(trajectory, known.lines, known.statistics, scans, known.horizontal_mount), CloudParams())
        for scans in (noisy, clean)
    ]
    return Place(clouds[0], mesh.vertices, mesh.triangles, clouds[1].points)


def simulated_place(name, seed=0, sigma=0.01):
    """A scene of `simulate` at true poses."""
    noisy, clean = simulated(name, seed=seed, range_sigma=sigma), simulated(name, seed=seed, range_sigma=0.0)
    truth = noisy.truth
    start = truth.poses[np.searchsorted(truth.time_ns, noisy.log.horizontal.time_ns[0])]
    # At 50 Hz: between the poses of the horizontal scans, beams of a robot that begins to turn would err by 4 mm.
    poses = Trajectory(truth.time_ns, se2.between(start, truth.poses), np.zeros((len(truth.poses), 3, 3)))
    clouds = [make_cloud(replace(true_slam_map(s), trajectory=poses), CloudParams()) for s in (noisy, clean)]
    back = se2.between(start, np.zeros(3))
    keep = np.isin(_key(clouds[1]), _key(clouds[0]))
    assert keep.sum() == len(clouds[0].points), "noise moved beams out of the limits"
    return Place(clouds[0], transform_points(back, noisy.vertices), noisy.triangles, clouds[1].points[keep])


def _key(cloud):
    return cloud.scan_index.astype(np.int64) * 10000 + cloud.beam_index


def read_pcd(path):
    """Points (n, 3) of a compressed PCD of float32 x y z."""
    with gzip.open(path) as file:
        data = file.read()
    head, body = data.split(b"DATA binary_compressed\n")
    count = int(next(line for line in head.split(b"\n") if line.startswith(b"POINTS")).split()[1])
    packed, size = np.frombuffer(body[:8], "<u4")
    return np.frombuffer(_lzf(body[8 : 8 + packed], int(size)), "<f4").reshape(3, count).T.astype(float)


def _lzf(data, size):
    """Decompress LZF."""
    out = bytearray()
    i = 0
    while i < len(data):
        control = data[i]
        i += 1
        if control < 32:
            out += data[i : i + control + 1]
            i += control + 1
            continue
        length = control >> 5
        if length == 7:
            length += data[i]
            i += 1
        start = len(out) - ((control & 31) << 8) - data[i] - 1
        i += 1
        for k in range(length + 2):
            out.append(out[start + k])
    assert len(out) == size
    return bytes(out)


def real_room():
    """The real room as a cloud: half planes through the vertical axis, one a scan, each point once."""
    points = read_pcd(REAL_ROOM)
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    steps = np.abs(np.diff(azimuth)) > np.radians(0.005)
    run = np.concatenate([[0], np.cumsum(steps)])
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    step = np.radians(0.97203)
    beam = np.rint((np.pi / 2 - elevation) / step).astype(int)
    centre = np.array([np.angle(np.mean(np.exp(1j * azimuth[run == k]))) for k in range(run[-1] + 1)])
    order = np.argsort(np.unwrap(centre), kind="stable")
    rank = np.argsort(order)
    _, first = np.unique(rank[run] * 1000 + beam, return_index=True)
    m, scan_of = len(order), rank[run][first]
    poses = np.column_stack([np.zeros((m, 2)), centre[order]])
    mount = np.eye(4)
    mount[:3, :3] = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])
    stamps = np.arange(m) * 25_000_000
    return PointCloud(
        points=points[first],
        scan_index=scan_of.astype(np.int32),
        beam_index=beam[first].astype(np.int32),
        time_ns=stamps[scan_of],
        covariances=np.tile([1e-4, 0, 0, 1e-4, 0, 1e-4], (len(first), 1)),
        scan_time_ns=stamps,
        scan_poses=poses,
        scan_pose_covariances=np.zeros((m, 3, 3)),
        mount=mount,
        angle_min=0.0,
        angle_increment=step,
        range_sigma=0.01,
        angle_sigma=0.0005,
    )
