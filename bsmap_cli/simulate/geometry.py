"""Triangle meshes of indoor scenes: free space carved out of solid boxes, and upright surfaces along a polyline.

Triangles are counter-clockwise seen from the free side, so that normals point into the room.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.model import Array, IntArray

LAYER_HEIGHT = 0.2  # m


class Mesh(NamedTuple):
    """Vertices (n, 3), metres in the scene frame, and triangles (m, 3) of vertex indices."""

    vertices: Array
    triangles: IntArray


class Box(NamedTuple):
    """Axis-aligned box, metres in the scene frame."""

    x0: float
    x1: float
    y0: float
    y1: float
    z0: float
    z1: float


class Cut(NamedTuple):
    """Fill a box with free space (a room, a doorway) or with matter (a cupboard)."""

    free: bool
    box: Box


def room(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float) -> Cut:
    """Box of free space."""
    return Cut(True, Box(x0, x1, y0, y1, z0, z1))


def solid(x0: float, x1: float, y0: float, y1: float, z0: float, z1: float) -> Cut:
    """Box of matter."""
    return Cut(False, Box(x0, x1, y0, y1, z0, z1))


def carve(cuts: Sequence[Cut]) -> Mesh:
    """Boundary of what is free after all cuts, made in turn in a world that starts solid.

    The mesh is watertight: space is divided into cells by the planes of all boxes, and each wall between a free cell
    and a solid one gives two triangles, with vertices shared between cells.
    """
    boxes = np.array([c.box for c in cuts])
    planes = [np.unique(boxes[:, 2 * k : 2 * k + 2]) for k in range(3)]
    free = np.zeros([len(p) + 1 for p in planes], dtype=bool)  # with a border of solid cells
    for cut in cuts:
        spans = [np.searchsorted(planes[k], cut.box[2 * k : 2 * k + 2]) + 1 for k in range(3)]
        free[tuple(slice(a, b) for a, b in spans)] = cut.free
    quads = np.concatenate([_walls_across(axis, free, planes) for axis in range(3)])
    corners, index = np.unique(quads.reshape(-1, 3), axis=0, return_inverse=True)
    return Mesh(corners, _split(index.reshape(-1, 4)))


def _walls_across(axis: int, free: np.ndarray, planes: list[Array]) -> Array:
    """Quads (n, 4, 3) between cells that are neighbours along an axis, one free and one solid."""
    change = np.diff(free.astype(np.int8), axis=axis)
    cells = np.argwhere(change)
    rises = change[tuple(cells.T)] > 0  # free on the upper side: the normal is along +axis
    a, b = (axis + 1) % 3, (axis + 2) % 3
    quads = np.empty((len(cells), 4, 3))
    quads[:, :, axis] = planes[axis][cells[:, axis], None]
    for corner, (da, db) in enumerate([(0, 0), (1, 0), (1, 1), (0, 1)]):
        quads[:, corner, a] = planes[a][cells[:, a] - 1 + da]
        quads[:, corner, b] = planes[b][cells[:, b] - 1 + db]
    quads[~rises] = quads[~rises, ::-1]
    return quads


def upright(line: Array, z0: float, z1: float) -> Mesh:
    """Wall from z0 to z1 over a polyline (n, 2), its free side to the right of the way along the line.

    It is made in layers of at most LAYER_HEIGHT: queries in float32 err at long thin triangles.
    """
    heights = np.linspace(z0, z1, int(np.ceil((z1 - z0) / LAYER_HEIGHT)) + 1)
    n, m = len(line), len(heights)
    vertices = np.column_stack([np.tile(line, (m, 1)), np.repeat(heights, n)])
    first = (np.arange(m - 1)[:, None] * n + np.arange(n - 1)).ravel()
    return Mesh(vertices, _split(np.column_stack([first, first + 1, first + 1 + n, first + n])))


def arc(centre: tuple[float, float], radius: float, start: float, stop: float, step: float = np.radians(0.5)) -> Array:
    """Polyline (n, 2) on a circle from angle `start` to `stop`; steps of half a degree leave 0.03 mm at 3 m."""
    angles = np.linspace(start, stop, int(np.ceil(abs(stop - start) / step)) + 1)
    return np.asarray(centre) + radius * np.column_stack([np.cos(angles), np.sin(angles)])


def join(meshes: Sequence[Mesh]) -> Mesh:
    """All meshes as one; vertices are not shared between them."""
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    triangles = np.concatenate([m.triangles + o for m, o in zip(meshes, offsets, strict=True)])
    return Mesh(np.concatenate([m.vertices for m in meshes]), triangles)


def _split(quads: IntArray) -> IntArray:
    """Two triangles (2n, 3) for each quad (n, 4)."""
    return quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
