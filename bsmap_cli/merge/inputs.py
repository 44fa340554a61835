"""Several maps as one: names of data sets and surfaces stay unique."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np

from bsmap_cli.model import BSplineSurface, Crease, HeightCovariance, SurfaceMap, TrimLoop


def unite(maps: Sequence[SurfaceMap]) -> SurfaceMap:
    """Surfaces, creases, data sets and former decisions of all maps in one.

    Where maps share a name, every name gets its map's number (from 1) in front.
    """
    if _clash([surface.name for surface in m.surfaces] for m in maps) or _clash(
        [data_set.name for data_set in m.data_sets] for m in maps
    ):
        maps = [_prefixed(m, f"{number}.") for number, m in enumerate(maps, start=1)]
    surfaces: list[BSplineSurface] = []
    creases: list[Crease] = []
    corners = 0
    for m in maps:
        surfaces += [_renumbered(surface, len(creases)) for surface in m.surfaces]
        creases += [_with_corners_from(crease, corners) for crease in m.creases]
        corners += len(m.corners)
    data_sets = tuple(data_set for m in maps for data_set in m.data_sets)
    decisions = tuple(decision for m in maps for decision in m.decisions)
    of_all = np.concatenate([m.corners for m in maps])
    return SurfaceMap(tuple(surfaces), data_sets, decisions, {}, tuple(creases), of_all)


def _with_corners_from(crease: Crease, start: int) -> Crease:
    """The crease, its corners counted from `start`."""
    first, last = (corner + start if corner >= 0 else -1 for corner in crease.corners)
    return replace(crease, corners=(first, last))


def _renumbered(surface: BSplineSurface, first: int) -> BSplineSurface:
    """The surface, its creases counted from `first`."""
    if first == 0 or not surface.trims:
        return surface
    loops = (TrimLoop(loop.parameters, loop.creases + first * (loop.creases >= 0)) for loop in surface.trims)
    return replace(surface, trims=tuple(loops))


def separate_faces(surfaces: Iterable[BSplineSurface]) -> tuple[list[BSplineSurface], list[BSplineSurface]]:
    """Surfaces that are divided into patches, and trimmed faces, which are joined whole."""
    whole: list[BSplineSurface] = []
    faces: list[BSplineSurface] = []
    for surface in surfaces:
        trimmed = bool(surface.trims) or isinstance(surface.covariance, HeightCovariance)
        (faces if trimmed else whole).append(surface)
    return whole, faces


def _clash(names: Iterable[Sequence[str]]) -> bool:
    counts = Counter(name for of_map in names for name in set(of_map))
    return any(count > 1 for count in counts.values())


def _prefixed(m: SurfaceMap, prefix: str) -> SurfaceMap:
    return replace(
        m,
        surfaces=tuple(_prefixed_surface(surface, prefix) for surface in m.surfaces),
        data_sets=tuple(replace(data_set, name=prefix + data_set.name) for data_set in m.data_sets),
        decisions=tuple(
            replace(d, first=prefix + d.first if d.first else "", second=prefix + d.second if d.second else "")
            for d in m.decisions
        ),
        creases=tuple(replace(c, surfaces=(prefix + c.surfaces[0], prefix + c.surfaces[1])) for c in m.creases),
    )


def _prefixed_surface(surface: BSplineSurface, prefix: str) -> BSplineSurface:
    pose = tuple(replace(part, data_set=prefix + part.data_set) for part in surface.covariance.pose)
    return replace(
        surface,
        name=prefix + surface.name,
        data_sets=tuple(prefix + name for name in surface.data_sets),
        covariance=replace(surface.covariance, pose=pose),
    )
