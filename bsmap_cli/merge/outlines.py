"""Outlines of joined faces: corners at creases brought onto the surfaces that now meet there, regions united."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np
import shapely

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.polygons import simplify
from bsmap_cli.fit.heights import HeightField, PlaneBase
from bsmap_cli.merge.bases import places_on
from bsmap_cli.merge.curves import FacePair, Shapes, onto
from bsmap_cli.merge.regions import Region, loops_of, region_of, united
from bsmap_cli.model import Array, BSplineSurface

TOLERANCE = 0.001
"""Metres by which a simplified outline may leave the union."""
FINE = 0.03
"""Metres between points of a side that is laid on a curved surface, before it is simplified."""


class Member(NamedTuple):
    """Loops of one face of a data set in map: corners (k, 3), the faces of the map that meet in each side, and metres
    (k,) of the bracket of each side that is a rim, else 0.
    """

    corners: list[Array]
    sides: list[list[FacePair | None]]
    rims: list[Array]


def member_of(surface: BSplineSurface, pairs: Sequence[FacePair | None]) -> Member:
    """Loops of a surface; pairs : of each crease of the map."""
    corners = [evaluate_surface(surface, *np.clip(loop.parameters, 0.0, 1.0).T) for loop in surface.trims]
    sides = [[pairs[c] if c >= 0 else None for c in loop.creases.tolist()] for loop in surface.trims]
    rims = [np.zeros(len(loop.creases)) if loop.rims is None else loop.rims for loop in surface.trims]
    return Member(corners, sides, rims)


def snapped(member: Member, face: int, shapes: Shapes) -> Member:
    """The member, its corners at creases brought onto the surfaces of the map that meet there."""
    corners = []
    for points, sides in zip(member.corners, member.sides, strict=True):
        new = points.copy()
        by_faces = defaultdict(list)
        for k in range(len(points)):
            met = {f for pair in (sides[k - 1], sides[k]) if pair for f in pair if f in shapes}
            if met - {face}:
                by_faces[tuple(sorted(met | {face}))].append(k)
        for met_faces, at in by_faces.items():
            new[at] = onto([shapes[f] for f in met_faces], points[at])
        corners.append(new)
    return member._replace(corners=corners)


class Seen(NamedTuple):
    """Region of a face of the map in s and t of its field's base, and those that each data set, or several that were
    joined before, saw.
    """

    whole: Region
    by_set: dict[tuple[str, ...], Region]


def seen(members: Sequence[Member], sets: Sequence[tuple[str, ...]], field: HeightField, gap: float) -> Seen:
    """Union of the members' regions.

    members : snapped.  sets : the data sets of each.
    """
    by_set: dict[tuple[str, ...], list[Region]] = defaultdict(list)
    for name, member in zip(sets, members, strict=True):
        by_set[name].append(_region(member, field))
    creases = np.concatenate([np.zeros((0, 2, 3)), *creased_sides(members).values()])
    regions = {name: shapely.union_all(some) for name, some in sorted(by_set.items())}
    return Seen(united(list(regions.values()), gap, field.base.local(creases)[..., :2]), regions)


def loops_around(region: Region, field: HeightField) -> list[Array]:
    """Loops (k, 3) around a region, on the surface of its face."""
    return [_following(ring, field) for ring in loops_of(region, TOLERANCE)]


def _region(member: Member, field: HeightField) -> Region:
    """Region of a member in s and t of the field's base."""
    loops = [field.base.local(points)[:, :2] for points in member.corners]
    if isinstance(field.base, PlaneBase):
        return region_of(loops)
    # A loop that crosses the line where s begins again goes on beyond it, and is cut there afterwards.
    turn = 2.0 * np.pi * field.base.radius
    loops = [np.column_stack([np.unwrap(st[:, 0], period=turn), st[:, 1]]) for st in loops]
    first = loops[0][:, 0].mean()
    once = np.array([turn, 0.0])
    region = region_of([st + once * np.round((first - st[:, 0].mean()) / turn) for st in loops])
    window = shapely.box(field.low[0], region.bounds[1], field.high[0], region.bounds[3])
    copies = [shapely.transform(region, lambda st, k=k: st + k * once) for k in (-1, 0, 1)]
    return shapely.union_all(shapely.intersection(copies, window))


def creased_sides(members: Iterable[Member]) -> dict[FacePair, Array]:
    """Sides (k, 2, 3) of the members' loops along creases, by the faces that meet there."""
    found: dict[FacePair, list[tuple[Array, Array]]] = defaultdict(list)
    for member in members:
        for points, sides in zip(member.corners, member.sides, strict=True):
            following = np.roll(points, -1, axis=0)
            for k, pair in enumerate(sides):
                if pair is not None:
                    found[pair].append((points[k], following[k]))
    return {pair: np.array(ends) for pair, ends in found.items()}


def _following(ring: Array, field: HeightField) -> Array:
    """(k, 3) the ring (n, 2) on the field, with corners more where its sides, straight in the base, follow a curve."""
    if field.knots.size == 4 and isinstance(field.base, PlaneBase):
        return _placed(ring, field)
    out = []
    for start, end in zip(ring, np.roll(ring, -1, axis=0), strict=True):
        share = np.linspace(0.0, 1.0, max(2, int(np.ceil(np.linalg.norm(end - start) / FINE)) + 1))
        points = _placed(start + share[:, None] * (end - start), field)
        out.append(points[simplify(points, TOLERANCE)][:-1])
    return np.concatenate(out)


def _placed(st: Array, field: HeightField) -> Array:
    """(n, 3) points in map on a field at s and t (n, 2)."""
    return places_on(field, (st - field.low) / (field.high - field.low))
