"""Several maps as one: names of data sets and surfaces stay unique."""

import itertools
from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bsmap_cli.model import Array, BSplineSurface, Crease, DataSet, Decision, HeightCovariance, SurfaceMap


class United(NamedTuple):
    """All maps in one.

    surfaces, data_sets : by name the number of the map (the survey) that they stem from.
    settled : numbers of those that are maps already, of joined faces: what lies close together in them is meant to.
    """

    whole: SurfaceMap
    surfaces: dict[str, int]
    data_sets: dict[str, int]
    settled: frozenset[int]


def unite(maps: Sequence[SurfaceMap]) -> United:
    """Surfaces, creases and data sets of all maps in one.

    Maps are taken in an order of their own, those of joined faces first (an old map before a new survey), then those of
    most data sets, so that the order in which they are given does not matter. The first keeps its names; where another
    one has a name that is taken, all its names get a number in front, from 2 on. Former decisions about pairs stay in
    their own artifacts.
    """
    surfaces: list[BSplineSurface] = []
    creases: list[Crease] = []
    data_sets: list[DataSet] = []
    decisions: list[Decision] = []
    survey: dict[str, int] = {}
    corners: list[Array] = [np.zeros((0, 3))]
    survey_of_set: dict[str, int] = {}
    ordered = sorted(maps, key=by_extent)
    for number, given in enumerate(ordered):
        m = _named_apart(given, survey.keys(), survey_of_set.keys())
        surfaces += [_renumbered(surface, len(creases)) for surface in m.surfaces]
        creases += [_with_corners_from(crease, sum(map(len, corners))) for crease in m.creases]
        corners.append(m.corners)
        data_sets += sorted(m.data_sets, key=lambda data_set: data_set.name)
        decisions += [d for d in m.decisions if d.first and not d.second and d.outcome == "refused"]
        survey |= {surface.name: number for surface in m.surfaces}
        survey_of_set |= {data_set.name: number for data_set in m.data_sets}
    whole = SurfaceMap(tuple(surfaces), tuple(data_sets), tuple(decisions), {}, tuple(creases), np.concatenate(corners))
    settled = frozenset(number for number, given in enumerate(ordered) if _is_joined(given))
    return United(whole, survey, survey_of_set, settled)


def _with_corners_from(crease: Crease, start: int) -> Crease:
    """The crease, its corners counted from `start`."""
    first, last = (corner + start if corner >= 0 else -1 for corner in crease.corners)
    return replace(crease, corners=(first, last))


def _is_joined(m: SurfaceMap) -> bool:
    """Whether it is a map of joined faces already."""
    return any(len(surface.data_sets) > 1 for surface in m.surfaces)


def by_extent(m: SurfaceMap) -> tuple[bool, int, int, int, list[list[float]]]:
    """Sorts maps of joined faces first, then by extent, then by content: names and order inside do not matter."""
    shapes = sorted(surface.control_points.ravel().round(9).tolist() for surface in m.surfaces)
    return (
        not _is_joined(m),
        -len(m.data_sets),
        len(m.surfaces),
        -sum(data_set.points for data_set in m.data_sets),
        shapes,
    )


def _named_apart(m: SurfaceMap, surfaces: Collection[str], data_sets: Collection[str]) -> SurfaceMap:
    """The map, its names told from those taken by surfaces and data sets."""
    own = [surface.name for surface in m.surfaces], [data_set.name for data_set in m.data_sets]
    prefixes = itertools.chain([""], (f"{number}." for number in itertools.count(2)))
    prefix = next(
        p
        for p in prefixes
        if not any(p + name in taken for names, taken in zip(own, (surfaces, data_sets), strict=True) for name in names)
    )
    return _prefixed(m, prefix) if prefix else m


def _renumbered(surface: BSplineSurface, first: int) -> BSplineSurface:
    """The surface, its creases counted from `first`."""
    if first == 0 or not surface.trims:
        return surface
    loops = (replace(loop, creases=loop.creases + first * (loop.creases >= 0)) for loop in surface.trims)
    return replace(surface, trims=tuple(loops))


def separate_faces(surfaces: Iterable[BSplineSurface]) -> tuple[list[BSplineSurface], list[BSplineSurface]]:
    """Surfaces that are divided into patches, and trimmed faces, which are joined whole."""
    whole: list[BSplineSurface] = []
    faces: list[BSplineSurface] = []
    for surface in surfaces:
        trimmed = bool(surface.trims) or isinstance(surface.covariance, HeightCovariance)
        (faces if trimmed else whole).append(surface)
    return whole, faces


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
