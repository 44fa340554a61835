"""Triangles of a trimmed surface: constrained Delaunay of its borders, with cells of a grid where it curves.

No point is added on a border: what lies on both sides of it has the same points there.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.polygons import winding_number
from bsmap_cli.export.borders import Border
from bsmap_cli.model import Array, BSplineSurface, IntArray

NEAR = 0.3
"""Of a cell of the grid: cells nearer to a border than this are left out."""
LONGEST = 4.0
"""Sides of a cell, the longer over the shorter; long cells would find no place between borders."""

Region = Any  # shapely's types are not known to the type checker


def triangulate(surface: BSplineSurface, border: Sequence[Border], u: Array, v: Array) -> tuple[Array, IntArray]:
    """Vertices (n, 3) and triangles (m, 3), counter-clockwise in the parameters, of what the borders wind around.

    u, v : parameters of a grid fine enough for the whole surface.
    """
    if not border:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
    scale = _lengths(surface)
    flat = [part.parameters * scale for part in border]
    region = _region([shapely.LinearRing(loop) for loop in flat], flat)
    cells = _cells(region, u * scale[0], v * scale[1])
    corners = [_corners_of_cells(cells)]
    for part in _without(region, cells):
        corners.append(shapely.get_coordinates(shapely.constrained_delaunay_triangles(part)).reshape(-1, 4, 2)[:, :3])
    return _numbered(surface, border, flat, np.concatenate(corners), scale)


def _lengths(surface: BSplineSurface) -> Array:
    """(2,) metres about along u and along v, so that triangles are well shaped in space."""
    P = surface.control_points
    along_u = np.linalg.norm(np.diff(P, axis=0), axis=2).sum(axis=0).mean()
    along_v = np.linalg.norm(np.diff(P, axis=1), axis=2).sum(axis=1).mean()
    return np.maximum([along_u, along_v], 1e-6)


def _polygons(lines: Region) -> list[Region]:
    return list(shapely.get_parts(shapely.polygonize([shapely.union_all(lines)])))


def _region(lines: Sequence[Region], loops: Sequence[Array]) -> list[Region]:
    """Polygons that loops (k, 2) wind around; where these do not cross, all their points are kept and none is added."""
    found = _polygons(lines)
    inner = shapely.get_coordinates(shapely.point_on_surface(found)) if found else np.zeros((0, 2))
    return [part for part, times in zip(found, winding_number(inner, loops), strict=True) if times != 0]


def _cells(region: Sequence[Region], u: Array, v: Array) -> Region:
    """Cells of the grid (k,) well inside the region, as boxes; none where one cell is fine enough."""
    if len(u) == 2 and len(v) == 2:
        return np.array([])
    widest = np.diff(u).max(), np.diff(v).max()
    u, v = (
        _finer(grid, int(np.ceil(own / (LONGEST * other))))
        for grid, own, other in zip((u, v), widest, widest[::-1], strict=True)
    )
    low = np.stack(np.meshgrid(u[:-1], v[:-1], indexing="ij"), axis=-1).reshape(-1, 2)
    high = np.stack(np.meshgrid(u[1:], v[1:], indexing="ij"), axis=-1).reshape(-1, 2)
    more = NEAR * (high - low)
    grown = shapely.box(*(low - more).T, *(high + more).T)
    whole = shapely.MultiPolygon(list(region))
    shapely.prepare(whole)
    return shapely.box(*low.T, *high.T)[shapely.contains_properly(whole, grown)]


def _finer(grid: Array, times: int) -> Array:
    """The grid, each step divided into `times`."""
    at = np.arange(max(times, 1) * (len(grid) - 1) + 1) / max(times, 1)
    return np.interp(at, np.arange(len(grid)), grid)


def _corners_of_cells(cells: Region) -> Array:
    """(2 k, 3, 2) corners of two triangles for each of k cells."""
    low, high = shapely.bounds(cells).reshape(-1, 2, 2).transpose(1, 0, 2)
    other = [np.column_stack([high[:, 0], low[:, 1]]), np.column_stack([low[:, 0], high[:, 1]])]
    return np.concatenate([np.stack([low, other[0], high], axis=1), np.stack([low, high, other[1]], axis=1)])


def _without(region: Sequence[Region], cells: Region) -> list[Region]:
    """The region without the cells, with the points of both."""
    if not len(cells):
        return list(region)
    taken = shapely.union_all(cells)
    shapely.prepare(taken)
    parts = np.array(_polygons([*(part.boundary for part in region), taken.boundary]))
    inner = shapely.point_on_surface(parts)
    whole = shapely.MultiPolygon(list(region))
    return list(parts[shapely.contains(whole, inner) & ~shapely.contains(taken, inner)])


def _numbered(
    surface: BSplineSurface, border: Sequence[Border], flat: Sequence[Array], corners: Array, scale: Array
) -> tuple[Array, IntArray]:
    """Vertices and triangles of corners (m, 3, 2) in metres along u and v; on borders they are the borders' points."""
    known, placed = np.concatenate(flat), np.concatenate([part.points for part in border])
    # What several creases share comes last and holds.
    order = np.argsort(np.concatenate([part.shared for part in border]), kind="stable")
    every, number = np.unique(np.concatenate([known[order], corners.reshape(-1, 2)]), axis=0, return_inverse=True)
    vertices = evaluate_surface(surface, *np.clip(every / scale, 0.0, 1.0).T)
    vertices[number[: len(known)]] = placed[order]
    a, b, c = np.moveaxis(corners, 1, 0)
    turned = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    triangles = number[len(known) :].reshape(-1, 3)
    return vertices, np.where(turned[:, None], triangles[:, ::-1], triangles)
