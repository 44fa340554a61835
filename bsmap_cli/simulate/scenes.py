"""The scenes: rooms, furniture and the robot's way through them, as data. Metres, z = 0 is the floor."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bsmap_cli.model import Array
from bsmap_cli.simulate.geometry import Cut, Mesh, arc, carve, join, room, solid, upright
from bsmap_cli.simulate.office import office_cuts, office_way
from bsmap_cli.simulate.path import Path, along, stepwise

DOOR = 2.05  # m, height of doorways


class Scene(NamedTuple):
    """What is there, and how the robot moves in it.

    scan_times : (n,) s at which a robot that moves stepwise stands and scans; None where it scans in motion.
    """

    mesh: Mesh
    path: Path
    scan_times: Array | None = None


def room_scene() -> Scene:
    """The paper's setting: a room with a concave rectangular recess in the ceiling, scanned in steps.

    Seven data sets: four translations of 19 steps of 100 mm with three rotations of 18 steps of 0.087 rad between.
    """
    mesh = carve(
        [
            room(0.0, 7.0, 0.0, 5.5, 0.0, 3.0),
            room(2.0, 5.0, 1.75, 3.75, 3.0, 3.3),  # the recess
            room(5.3, 6.2, 5.5, 5.65, 0.0, 2.05),  # a door in its frame
            solid(3.0, 4.2, 0.0, 0.3, 0.0, 3.0),  # a pilaster
            solid(0.0, 0.6, 3.6, 5.5, 0.0, 2.0),  # a cupboard
            solid(6.3, 7.0, 0.0, 1.6, 0.0, 0.9),  # a chest of drawers
        ]
    )
    forward, turn = [[0.1, 0.0]] * 19, [[0.0, 0.087]] * 18
    steps = np.array(forward + turn + forward + turn + forward + turn + forward)
    path, scan_times = stepwise((2.5, 1.8, 0.04), steps)
    return Scene(mesh, path, scan_times)


def corridor_scene() -> Scene:
    """Two corridors that meet in a lobby with a curved wall and a pillar, doorways open to rooms; 0.5 m/s with arcs."""
    boxes = carve(
        [
            room(0.0, 18.0, 0.0, 2.2, 0.0, 2.6),  # first corridor, along x
            room(18.0, 23.0, 0.0, 5.0, 0.0, 3.2),  # lobby
            room(20.8, 23.0, 5.0, 15.0, 0.0, 2.6),  # second corridor, along y
            solid(14.0, 14.3, 0.0, 2.2, 2.3, 2.6),  # a beam under the ceiling
            room(3.0, 3.9, 2.2, 2.35, 0.0, DOOR),
            room(0.5, 6.0, 2.35, 6.0, 0.0, 2.6),
            solid(0.5, 1.3, 4.4, 6.0, 0.0, 0.75),
            solid(4.6, 6.0, 5.5, 6.0, 0.0, 1.8),
            room(6.5, 7.4, -0.15, 0.0, 0.0, DOOR),
            room(4.5, 9.5, -3.65, -0.15, 0.0, 2.6),
            solid(8.7, 9.5, -2.6, -1.2, 0.0, 0.75),
            room(10.0, 10.9, 2.2, 2.35, 0.0, DOOR),
            room(7.0, 13.0, 2.35, 5.5, 0.0, 2.6),
            solid(9.6, 11.6, 5.0, 5.5, 0.0, 1.2),
            room(12.6, 13.5, -0.1, 0.0, 0.0, DOOR),  # a closed door
            solid(16.0, 17.2, 2.05, 2.2, 0.1, 0.8),  # a radiator
            room(23.0, 23.15, 8.5, 9.4, 0.0, DOOR),
            room(23.15, 27.0, 7.0, 11.0, 0.0, 2.6),
            solid(26.4, 27.0, 8.0, 10.0, 0.0, 1.1),
            room(20.65, 20.8, 11.5, 12.4, 0.0, DOOR),
            room(17.0, 20.65, 10.0, 13.5, 0.0, 2.6),
            solid(17.0, 17.6, 10.0, 11.5, 0.0, 1.9),
            solid(20.8, 21.05, 6.5, 7.0, 0.0, 2.6),  # a pilaster
        ]
    )
    curved_wall = upright(arc((20.0, 3.0), 3.0, 0.0, -np.pi / 2), 0.0, 3.2)
    pillar = upright(arc((19.6, 3.3), 0.25, 0.0, 2 * np.pi, np.radians(2.0)), 0.0, 3.2)
    waypoints = [[1.2, 1.1], [6.0, 1.1], [9.0, 1.5], [12.5, 0.9], [16.0, 1.1], [21.9, 1.1], [21.9, 9.0], [22.2, 13.6]]
    return Scene(join([boxes, curved_wall, pillar]), along(np.array(waypoints), radius=1.2, speed=0.5))


def loop_scene() -> Scene:
    """Corridor round a block, with doorways open to rooms, niches and pilasters; 0.6 m/s, once round and 4 m more."""
    mesh = carve([*_ring(), *_south_and_east(), *_north_and_west()])
    waypoints = np.array([[8.0, 1.1], [30.9, 1.1], [30.9, 20.9], [1.1, 20.9], [1.1, 1.1], [12.0, 1.1]])
    return Scene(mesh, along(waypoints, radius=0.9, speed=0.6))


def _ring() -> list[Cut]:
    """Corridor 2.2 m wide, its middle 99 m long, with beams under the ceiling."""
    return [
        room(0.0, 32.0, 0.0, 22.0, 0.0, 2.6),
        solid(2.2, 29.8, 2.2, 19.8, 0.0, 2.6),
        solid(18.0, 18.3, 0.0, 2.2, 2.3, 2.6),
        solid(29.8, 32.0, 11.0, 11.3, 2.3, 2.6),
        solid(15.0, 15.4, 19.8, 22.0, 2.25, 2.6),
    ]


def _south_and_east() -> list[Cut]:
    """Doorways, rooms and niches at the first two sides of the ring."""
    return [
        room(5.0, 5.9, -0.15, 0.0, 0.0, DOOR),
        room(2.0, 9.0, -4.15, -0.15, 0.0, 2.6),
        solid(2.0, 2.6, -3.0, -1.5, 0.0, 1.9),
        room(14.0, 14.9, 2.2, 2.35, 0.0, DOOR),
        room(11.0, 18.0, 2.35, 6.5, 0.0, 2.6),
        solid(13.0, 15.5, 5.7, 6.5, 0.0, 0.75),
        solid(10.5, 10.9, 0.0, 0.2, 0.0, 2.6),  # a pilaster
        room(20.0, 21.2, -0.4, 0.0, 0.0, 2.2),  # a niche
        room(25.0, 25.9, -0.15, 0.0, 0.0, DOOR),
        room(22.0, 28.0, -3.65, -0.15, 0.0, 2.6),
        room(32.0, 32.35, 5.0, 6.0, 0.0, 2.2),  # a niche
        room(29.65, 29.8, 8.0, 8.9, 0.0, DOOR),
        room(25.0, 29.65, 6.5, 11.0, 0.0, 2.6),
        solid(25.0, 25.6, 7.0, 9.5, 0.0, 1.2),
        room(32.0, 32.15, 14.0, 14.9, 0.0, DOOR),
        room(32.15, 36.0, 12.0, 17.0, 0.0, 2.6),
        solid(29.8, 30.0, 16.2, 16.8, 0.0, 2.6),  # a pilaster
    ]


def _north_and_west() -> list[Cut]:
    """Doorways, rooms and niches at the last two sides of the ring."""
    return [
        room(24.0, 24.9, 19.65, 19.8, 0.0, DOOR),
        room(21.0, 27.0, 15.5, 19.65, 0.0, 2.6),
        solid(26.3, 27.0, 16.0, 18.0, 0.0, 0.9),
        room(18.0, 19.2, 22.0, 22.4, 0.0, 2.2),  # a niche
        room(13.0, 13.9, 22.0, 22.1, 0.0, DOOR),  # a closed door
        room(11.0, 12.0, 19.65, 19.8, 0.0, DOOR),
        room(9.0, 15.0, 16.0, 19.65, 0.0, 2.6),
        room(6.5, 7.4, 22.0, 22.15, 0.0, DOOR),
        room(4.0, 10.0, 22.15, 26.0, 0.0, 2.6),
        solid(4.0, 5.0, 25.2, 26.0, 0.0, 1.9),
        room(-0.15, 0.0, 15.0, 15.9, 0.0, DOOR),
        room(-4.15, -0.15, 13.0, 18.0, 0.0, 2.6),
        room(-0.4, 0.0, 9.5, 10.7, 0.0, 2.2),  # a niche
        room(2.2, 2.35, 6.0, 6.9, 0.0, DOOR),
        room(2.35, 7.0, 4.5, 9.0, 0.0, 2.6),
        solid(6.2, 7.0, 5.0, 7.0, 0.0, 0.75),
    ]


def walls_scene() -> Scene:
    """Four rooms side by side, the walls between them 5, 10 and 20 cm thick, a door leaf 5 cm before a wall; 0.4 m/s.

    The way winds through wide doorways along both sides of each wall.
    """
    mesh = carve(
        [
            room(0.0, 6.6, 0.0, 2.4, 0.0, 2.6),
            solid(0.0, 0.5, 0.0, 0.9, 0.0, 1.8),
            room(4.8, 6.1, 2.4, 2.45, 0.0, DOOR),
            room(0.0, 6.19, 2.45, 4.85, 0.0, 2.6),
            solid(6.1, 6.14, 2.45, 3.75, 0.01, DOOR - 0.01),  # the leaf of the first door
            solid(2.6, 4.2, 4.5, 4.85, 0.0, 0.8),
            room(0.7, 2.0, 4.85, 4.95, 0.0, DOOR),
            room(0.2, 7.2, 4.95, 7.35, 0.0, 2.8),
            solid(6.7, 7.2, 4.95, 5.6, 0.0, 1.1),
            room(4.8, 6.1, 7.35, 7.55, 0.0, DOOR),
            room(0.0, 6.8, 7.55, 9.95, 0.0, 2.6),
            solid(2.0, 3.0, 9.5, 9.95, 0.0, 1.8),
        ]
    )
    waypoints = [[1.0, 1.2], [5.45, 1.2], [5.45, 3.65], [1.35, 3.65], [1.35, 6.15], [5.45, 6.15], [5.45, 8.75]]
    return Scene(mesh, along(np.array([*waypoints, [1.2, 8.75]]), radius=0.7, speed=0.4))


def steps_scene() -> Scene:
    """Room with steps of 4 cm in walls and floor, and an open door leaf 6 cm before a wall; 0.4 m/s, 1.5 rounds.

    In the south a panel fills half of the wall, in the east one stands amid the wall; a low platform lies on the floor.
    """
    mesh = carve(
        [
            room(0.0, 7.0, 0.0, 6.0, 0.0, 2.8),
            solid(3.4, 7.0, 0.0, 0.04, 0.0, 2.8),  # the panel in the south
            solid(6.96, 7.0, 2.2, 3.8, 0.0, 2.1),  # the panel in the east
            solid(2.5, 4.5, 2.3, 3.7, 0.0, 0.04),  # the platform
            room(1.6, 2.6, 6.0, 6.15, 0.0, DOOR),
            room(0.8, 3.4, 6.15, 7.6, 0.0, 2.6),
            solid(2.6, 3.6, 5.9, 5.94, 0.01, DOOR - 0.01),  # the leaf of the door, turned to the wall beside it
            solid(0.0, 0.5, 2.0, 3.2, 0.0, 1.9),
        ]
    )
    round_once = [[5.7, 1.3], [5.7, 4.7], [1.3, 4.7], [1.3, 1.3]]
    waypoints = np.array([[2.2, 1.3], *round_once, *round_once[:2], [2.8, 4.7]])
    return Scene(mesh, along(waypoints, radius=0.7, speed=0.4))


def office_scene() -> Scene:
    """Floor of offices, 72 m by 50 m, its corridors driven through for 1 km in many loops; 0.7 m/s."""
    return Scene(carve(office_cuts()), along(np.array(office_way()), radius=0.9, speed=0.7))


SCENES: dict[str, Callable[[], Scene]] = {
    "room": room_scene,
    "corridor": corridor_scene,
    "loop": loop_scene,
    "walls": walls_scene,
    "steps": steps_scene,
    "office": office_scene,
}
