"""One layer only: where two faces of the map lie on each other, the one that fewer data sets saw there ends.

Nobody sees two surfaces that look the same way and lie closer than a hand's breadth at one place. What does so all the
same is an outline that reaches too far, or a face that leans.
"""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import shapely

from bsmap_cli.fit.heights import HeightField, offset
from bsmap_cli.merge.bases import places_on
from bsmap_cli.merge.outlines import Seen
from bsmap_cli.merge.regions import GRID, LEAST_AREA, Region, parts, region_of, without_specks
from bsmap_cli.merge.rings import Ring
from bsmap_cli.model import Array, IntArray

CLOSE = 0.03
"""Metres between surfaces at some place of an overlap, below which they are one layer there."""
ALIKE = 0.9
"""Cosine between normals somewhere in an overlap: edges meet in larger angles."""
HALF = 0.5
"""Share of the smaller face beyond which an overlap that as many data sets saw on both is not cut off it."""
STEP = 0.05
"""Metres between vertices of an outline that is laid on another surface."""
PLACES = 100
"""About so many of an overlap at which data sets are counted."""
MOST_PLACES = 10_000
"""Of a grid around it from which these are taken."""


def cut_back(
    rings: Mapping[int, Sequence[Ring]],
    seen: Mapping[int, Seen],
    fields: Mapping[int, HeightField],
    pairs: Iterable[tuple[int, int]],
    distance: float,
) -> dict[int, Region]:
    """Regions of those faces, by number, of which something lies on another one that more data sets saw there.

    Parameters
    ----------
    rings : around the faces.  seen : by which data sets.
    pairs : of faces over planes that do not look opposite ways.
    distance : metres; what is farther apart anywhere in an overlap stays.
    """
    left = {k: region_of([fields[k].base.local(ring.points)[:, :2] for ring in rings[k]]) for k in fields if k in rings}
    cut = set()
    for a, b in sorted(pairs):
        for part in _overlaps(left, fields, a, b, distance) if a in left and b in left else []:
            points = _places(part, fields[a])
            more = np.sum(_sets(points, seen[a], fields[a]) - _sets(points, seen[b], fields[b]))
            if more == 0 and part.area > HALF * min(left[a].area, left[b].area):
                continue
            if more > 0 or (more == 0 and left[a].area >= left[b].area):
                left[b] = _without(left[b], _laid(part, fields[a], fields[b]))
                cut.add(b)
            else:
                left[a] = _without(left[a], part)
                cut.add(a)
    return {number: without_specks(left[number]) for number in sorted(cut)}


def _overlaps(
    left: Mapping[int, Region], fields: Mapping[int, HeightField], a: int, b: int, distance: float
) -> list[Region]:
    """Parts of the first of two faces where both are one layer."""
    both = shapely.intersection(left[a], _laid(left[b], fields[b], fields[a]), grid_size=GRID)
    found = []
    for part in parts(both):
        if part.area < LEAST_AREA:
            continue
        points = _places(part, fields[a])
        above, normals = offset(fields[b], points)
        apart, along = np.abs(above), np.abs(np.sum(offset(fields[a], points)[1] * normals, axis=1))
        if apart.min() < CLOSE and apart.max() < distance and along.max() > ALIKE:
            found.append(part)
    return found


def _without(region: Region, part: Region) -> Region:
    """What of a region is left without a part of it."""
    return shapely.MultiPolygon(parts(shapely.difference(region, part, grid_size=GRID)))


def _laid(region: Region, field: HeightField, on: HeightField) -> Region:
    """A region of one field in s and t of another one's base."""
    fine = shapely.segmentize(region, STEP)
    there = shapely.transform(fine, lambda st: on.base.local(_on(st, field))[:, :2])
    return shapely.make_valid(there, method="structure", keep_collapsed=False)


def _on(st: Array, field: HeightField) -> Array:
    """(n, 3) points of a field at s and t (n, 2)."""
    return places_on(field, (st - field.low) / (field.high - field.low))


def _places(part: Region, field: HeightField) -> Array:
    """(n, 3) points of a field all over a part of its base."""
    low_s, low_t, high_s, high_t = part.bounds
    # Of a narrow part that runs askew few places of a grid lie inside.
    step = np.sqrt(max(part.area / PLACES, (high_s - low_s) * (high_t - low_t) / MOST_PLACES))
    s, t = (np.arange(low + step / 2.0, high, step) for low, high in ((low_s, high_s), (low_t, high_t)))
    grid = np.stack(np.meshgrid(s, t, indexing="ij"), axis=-1).reshape(-1, 2)
    inside = grid[shapely.contains_xy(part, grid)]
    return _on(np.concatenate([inside, shapely.get_coordinates(shapely.point_on_surface(part))]), field)


def _sets(points: Array, seen: Seen, field: HeightField) -> IntArray:
    """(n,) how many data sets saw a face at points (n, 3)."""
    st = field.base.local(points)[:, :2]
    return np.sum([len(names) * shapely.contains_xy(r, st) for names, r in seen.by_set.items()], axis=0)
