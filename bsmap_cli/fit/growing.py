"""Smooth regions of points without any order: normals of neighbourhoods, and neighbours that agree joined.

As in Rabbani, van den Heuvel and Vosselman, Segmentation of point clouds using smoothness constraint (2006), but all
regions at once: they are the connected components of the graph of neighbours that agree in normal and offset.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bsmap_cli.model import Array, IntArray

SAMPLES = 2000
"""Neighbourhoods from which the scale of a cloud is told."""
FLAT = 0.15
"""A neighbourhood wide enough to tell a surface from its noise is this flat: root of the smallest by the middle
eigenvalue."""
NEIGHBOURS = 16
"""Cells of a neighbourhood."""
ROUGH = 0.25
"""Neighbourhoods less flat than this lie on an edge, or on nothing smooth."""
BEND = np.radians(8.0)
"""Largest angle between the normals of neighbours in one region."""
FINEST_NOISE = 0.005
"""Of the spacing: least noise, for clouds without any."""
MOST_CELLS = 250_000
LARGEST_KEY = 2**20


class Scale(NamedTuple):
    """spacing : metres between points.  sigma : metres, noise across surfaces.  cell : metres, side of the cells."""

    spacing: float
    sigma: float
    cell: float


class Cells(NamedTuple):
    """A cloud thinned to the mean points of occupied cells.

    points : (m, 3) in map.  of_point : (n,) the cell of each point.  counts : (m,) points of each.
    """

    points: Array
    of_point: IntArray
    counts: IntArray


class Normals(NamedTuple):
    """neighbours : (m, k) nearest cells, the nearest first.  normals : (m, 3) unit.  smooth : (m,)."""

    neighbours: IntArray
    normals: Array
    smooth: NDArray[np.bool_]


def measure_scale(points: Array) -> Scale:
    """Scale of a cloud of distinct points (n, 3), in an order that means nothing but is always the same.

    Neighbourhoods are widened until the median one is flat; how thick it is tells the noise.
    """
    tree = cKDTree(points)
    sample = points[np.linspace(0, len(points) - 1, min(SAMPLES, len(points))).astype(np.int64)]
    k = min(NEIGHBOURS, len(points))
    while True:
        reach, neighbours = nearest(tree, sample, k)
        squares = np.maximum(_spread(points[neighbours])[0], 0.0)
        flatness = np.sqrt(squares[:, 0] / np.maximum(squares[:, 1], 1e-300))
        if np.median(flatness) < FLAT or 2 * k > min(1024, len(points) // 4):
            break
        k *= 2
    radius = float(np.median(reach[:, -1]))
    sigma = float(np.median(np.sqrt(squares[:, 0] * k / max(k - 3, 1))))
    spacing = radius * float(np.sqrt(np.pi / k))
    return Scale(spacing, max(sigma, FINEST_NOISE * spacing), max(2.0 * spacing, radius / 3.0))


def nearest(tree: "cKDTree[None]", points: Array, k: int) -> tuple[Array, IntArray]:
    """Distances and numbers (n, k) of the points of a tree next to points (n, d), ascending."""
    distances, numbers = tree.query(points, np.arange(1, k + 1))
    return np.asarray(distances), np.asarray(numbers, dtype=np.int64)


def thin(points: Array, size: float) -> Cells:
    """Mean points of the occupied cells of side `size` metres, or wider where there would be too many."""
    while True:
        cells = group(points, points, size)
        if len(cells.points) <= MOST_CELLS:
            return cells
        size *= 1.3


def group(points: Array, coordinates: Array, size: float) -> Cells:
    """Points (n, 3) by the cells of side `size` in which their coordinates (n, 2 or 3) lie."""
    low, high = coordinates.min(axis=0), coordinates.max(axis=0)
    index = ((coordinates - low) / max(size, 1e-300)).astype(np.int64)
    if float((high - low).max()) > LARGEST_KEY * size:  # a few points far away: number the rows in use
        index = np.column_stack([np.unique(column, return_inverse=True)[1] for column in index.T])
    key = index[:, 0]
    for column in index.T[1:]:
        key = key * (LARGEST_KEY + 1) + column
    _, of_point, counts = np.unique(key, return_inverse=True, return_counts=True)
    origin = points.mean(axis=0)
    sums = [np.bincount(of_point, axis) for axis in (points - origin).T]
    return Cells(origin + np.column_stack(sums) / counts[:, None], of_point, counts)


def _spread(neighbourhoods: Array) -> tuple[Array, Array]:
    """Eigenvalues (m, 3), ascending, and eigenvectors (m, 3, 3) of the scatter of neighbourhoods (m, k, 3)."""
    centred = neighbourhoods - neighbourhoods.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ centred / neighbourhoods.shape[1])
    return np.asarray(values), np.asarray(vectors)


def find_normals(points: Array) -> Normals:
    """Normals of the neighbourhoods of points (m, 3)."""
    neighbours = nearest(cKDTree(points), points, min(NEIGHBOURS, len(points)))[1]
    values, vectors = _spread(points[neighbours])
    smooth = values[:, 0] < ROUGH**2 * values[:, 1]
    return Normals(neighbours, vectors[:, :, 0], smooth)


def grow(points: Array, found: Normals, members: IntArray, bend: float, sigma: float) -> list[IntArray]:
    """Regions among the cells `members`, each a list of cells, the largest first.

    bend : largest angle between neighbouring normals, radians.  sigma : metres, noise of a cell's point.
    """
    inside = np.zeros(len(points), dtype=bool)
    inside[members] = True
    inside &= found.smooth
    a = np.repeat(np.arange(len(points)), found.neighbours.shape[1] - 1)
    b = found.neighbours[:, 1:].ravel()
    kept = inside[a] & inside[b]
    a, b = a[kept], b[kept]
    step = points[b] - points[a]
    room = 2.0 * sigma + bend * np.linalg.norm(step, axis=1)
    agree = np.abs(np.sum(found.normals[a] * found.normals[b], axis=1)) > np.cos(bend)
    for end in (a, b):
        agree &= np.abs(np.sum(found.normals[end] * step, axis=1)) < room
    a, b = a[agree], b[agree]
    graph = coo_matrix((np.ones(len(a), dtype=np.int8), (a, b)), shape=(len(points), len(points)))
    label = connected_components(graph, directed=False)[1]
    members = np.flatnonzero(inside)
    members = members[np.argsort(label[members], kind="stable")]
    parts = np.split(members, np.flatnonzero(np.diff(label[members])) + 1) if len(members) else []
    return sorted(parts, key=lambda part: (-len(part), int(part[0])))
