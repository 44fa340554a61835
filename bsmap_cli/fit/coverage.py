"""Outlines of what scattered points cover: triangles between neighbours, as far as the points' own spacing reaches."""

import numpy as np
from scipy.spatial import Delaunay, QhullError, cKDTree

from bsmap_cli.core.polygons import signed_area, simplify
from bsmap_cli.fit.growing import group, nearest
from bsmap_cli.fit.outline import chain
from bsmap_cli.model import Array, IntArray

NEIGHBOURS = 8
REACH = 1.2
"""Largest radius of a covered triangle's circle, in distances to the eighth neighbour."""
LEAST_LOOP = 6.0
"""Squares of the spacing; smaller loops, and holes, are chance."""


def spacing_of(flat: Array) -> float:
    """Metres between points (n, 2) in a plane: side of the square that the median one has to itself."""
    k = min(NEIGHBOURS, len(flat) - 1)
    sample = flat[np.linspace(0, len(flat) - 1, min(2000, len(flat))).astype(np.int64)]
    reach = nearest(cKDTree(flat), sample, k + 1)[0][:, -1]
    return float(np.median(reach) * np.sqrt(np.pi / k))


def cover(flat: Array, least: float) -> list[Array]:
    """Loops (k, 2) around what points (n, 2) cover, counter-clockwise, holes clockwise; the widest first.

    least : metres, spacing below which points are taken together.
    """
    cell = 1.5 * max(spacing_of(flat), least)
    raised = np.column_stack([flat, np.zeros(len(flat))])
    places = group(raised, flat, cell).points[:, :2]
    triangles = _covered(places, cell)
    loops = [places[loop] for loop in _loops(triangles)]
    wide = [(area, loop) for loop in loops if (area := abs(float(signed_area(loop)))) > LEAST_LOOP * cell**2]
    wide.sort(key=lambda pair: -pair[0])
    simple = (_simplified(loop, 0.7 * cell) for _, loop in wide)
    return [loop for loop in simple if len(loop) >= 3]


def _covered(places: Array, cell: float) -> IntArray:
    """(m, 3) counter-clockwise Delaunay triangles that are small for their surroundings."""
    if len(places) <= NEIGHBOURS:
        return np.zeros((0, 3), dtype=np.int64)
    try:
        triangles = Delaunay(places - places.mean(axis=0)).simplices.astype(np.int64)
    except QhullError:  # all in one line
        return np.zeros((0, 3), dtype=np.int64)
    spread = np.maximum(nearest(cKDTree(places), places, NEIGHBOURS + 1)[0][:, -1], 1.5 * cell)
    a, b, c = (places[triangles[:, k]] for k in range(3))
    twice = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    sides = np.linalg.norm(a - b, axis=1) * np.linalg.norm(b - c, axis=1) * np.linalg.norm(c - a, axis=1)
    radius = sides / np.maximum(2.0 * np.abs(twice), 1e-300)
    triangles[twice < 0.0] = triangles[twice < 0.0][:, ::-1]
    return np.asarray(triangles[radius < REACH * np.median(spread[triangles], axis=1)])


def _loops(triangles: IntArray) -> list[list[int]]:
    """Borders of triangles (m, 3), each on the left of its loop."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    size = int(triangles.max(initial=0)) + 1
    there, back = sides[:, 0] * size + sides[:, 1], sides[:, 1] * size + sides[:, 0]
    return chain(sides[~np.isin(there, back)])


def _simplified(loop: Array, tolerance: float) -> Array:
    """A closed loop with few vertices, as two lines between its first vertex and the one farthest from it."""
    half = int(np.argmax(np.linalg.norm(loop - loop[0], axis=1)))
    first, second = loop[: half + 1], np.concatenate([loop[half:], loop[:1]])
    lines = [line[simplify(line, tolerance)][:-1] for line in (first, second)]
    return np.concatenate(lines)
