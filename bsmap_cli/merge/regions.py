"""Regions of faces as polygons with holes: from trim loops, united, narrow gaps closed, and back to loops."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely

from bsmap_cli.core.polygons import winding_number
from bsmap_cli.model import Array

GRID = 1e-5
"""Metres to which corners are rounded when regions are united, so that lines drawn twice coincide."""
LEAST_AREA = 4e-4
"""Square metres; smaller parts and holes are dropped."""

ALONG = 0.001
"""Metres from a crease within which the border of a gap runs along it."""

ALONG_CREASES = 0.4
"""Of the border of a gap, how much runs along creases where a wall stands in it: one of its long sides is enough."""

NO_SIDES = np.zeros((0, 2, 2))

Region = Any  # shapely's types are not known to the type checker


def region_of(loops: Sequence[Array]) -> Region:
    """What loops (k, 2) wind around, together: they may overlap, hole loops run clockwise."""
    lines = shapely.union_all([shapely.LinearRing(loop) for loop in loops if len(loop) > 2], grid_size=GRID)
    cells = np.array(shapely.polygonize([lines]).geoms)
    if not len(cells):
        return shapely.Polygon()
    inner = shapely.get_coordinates(shapely.point_on_surface(cells))
    return shapely.union_all(cells[winding_number(inner, loops) != 0], grid_size=GRID)


def united(regions: Sequence[Region], gap: float, creases: Array = NO_SIDES) -> Region:
    """Union of the regions of several data sets, gaps between them that are narrower than `gap` closed.

    What lies inside the outline of a single region is no gap: a hole that one data set saw stays open. Nor is what lies
    along creases: there stands a thin wall.

    creases : (k, 2, 2) sides of the regions along creases.
    """
    whole = shapely.union_all(list(regions), grid_size=GRID)
    if gap > 0.0 and len(regions) > 1:
        grown = shapely.buffer(whole, gap / 2.0, join_style="mitre", mitre_limit=2.0)
        closed = shapely.buffer(grown, -gap / 2.0 - GRID, join_style="mitre", mitre_limit=2.0)
        # Mitres of a ragged outline may cross.
        closed = shapely.make_valid(closed, method="structure", keep_collapsed=False)
        holes = shapely.union_all([shapely.difference(filled(region), region) for region in regions])
        added = shapely.difference(shapely.difference(closed, whole), holes)
        lines = shapely.STRtree(list(shapely.linestrings(creases)))
        filled_in = (inner for part in parts(added) for inner in parts(without_mitres(part, whole)))
        between = [part for part in filled_in if _touched(part, regions) > 1 and not _between(part, lines)]
        whole = shapely.union_all([whole, *between], grid_size=GRID)
    return without_specks(whole)


def without_mitres(part: Region, whole: Region) -> Region:
    """What of a gap lies between places where it touches the regions: mitres of ragged outlines stand out farther."""
    low_s, low_t, high_s, high_t = part.bounds
    near = shapely.intersection(whole, shapely.box(low_s - GRID, low_t - GRID, high_s + GRID, high_t + GRID))
    touched = shapely.intersection(part, shapely.buffer(near, 2.0 * GRID))
    return shapely.intersection(part, shapely.convex_hull(touched), grid_size=GRID)


def filled(region: Region) -> Region:
    """The region, its holes closed."""
    return shapely.union_all([shapely.Polygon(part.exterior) for part in parts(region)])


def parts(region: Region) -> list[Region]:
    """Polygons of a region."""
    return [part for part in shapely.get_parts(region) if part.geom_type == "Polygon" and not part.is_empty]


def _between(part: Region, creases: shapely.STRtree) -> bool:
    """Whether a part's border runs along creases, given as a tree: all of them at once cost their square."""
    near = creases.geometries[creases.query(part, predicate="dwithin", distance=ALONG)]
    along = shapely.buffer(shapely.MultiLineString(list(near)), ALONG)
    return bool(shapely.intersection(part.boundary, along).length > ALONG_CREASES * part.length)


def _touched(part: Region, regions: Sequence[Region]) -> int:
    return int(np.count_nonzero(shapely.distance(part, list(regions)) < 2.0 * GRID))


def without_specks(region: Region) -> Region:
    """The region, its small parts dropped and small holes closed."""
    kept = []
    for part in parts(region):
        if part.area >= LEAST_AREA:
            holes = [hole for hole in part.interiors if shapely.Polygon(hole).area >= LEAST_AREA]
            kept.append(shapely.Polygon(part.exterior, holes))
    return shapely.MultiPolygon(kept)


def loops_of(region: Region, tolerance: float) -> list[Array]:
    """Loops (k, 2) around a region with few vertices: outlines counter-clockwise, holes clockwise."""
    loops = []
    for part in parts(shapely.simplify(region, tolerance)):
        part = shapely.orient_polygons(part)
        for ring in (part.exterior, *part.interiors):
            if shapely.Polygon(ring).area >= LEAST_AREA:
                loops.append(shapely.get_coordinates(ring)[:-1])
    return loops
