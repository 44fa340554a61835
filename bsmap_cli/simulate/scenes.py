"""The scenes: rooms, furniture and the robot's way through them, as data. Metres, z = 0 is the floor."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from bsmap_cli.model import Array
from bsmap_cli.simulate.geometry import Mesh, carve, room, solid
from bsmap_cli.simulate.path import Path, stepwise


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


SCENES: dict[str, Callable[[], Scene]] = {"room": room_scene}
