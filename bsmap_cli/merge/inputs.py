"""Several maps as one: names of data sets and surfaces stay unique."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace

from bsmap_cli.model import BSplineSurface, DataSet, Decision, SurfaceMap


def unite(maps: Sequence[SurfaceMap]) -> tuple[list[BSplineSurface], list[DataSet], list[Decision]]:
    """Surfaces, data sets and former decisions of all maps.

    Where maps share a name, every name gets its map's number (from 1) in front.
    """
    if _clash([surface.name for surface in m.surfaces] for m in maps) or _clash(
        [data_set.name for data_set in m.data_sets] for m in maps
    ):
        maps = [_prefixed(m, f"{number}.") for number, m in enumerate(maps, start=1)]
    surfaces = [surface for m in maps for surface in m.surfaces]
    data_sets = [data_set for m in maps for data_set in m.data_sets]
    return surfaces, data_sets, [decision for m in maps for decision in m.decisions]


def _clash(names: Iterable[Sequence[str]]) -> bool:
    counts = Counter(name for of_map in names for name in set(of_map))
    return any(count > 1 for count in counts.values())


def _prefixed(m: SurfaceMap, prefix: str) -> SurfaceMap:
    return replace(
        m,
        surfaces=tuple(_prefixed_surface(surface, prefix) for surface in m.surfaces),
        data_sets=tuple(replace(data_set, name=prefix + data_set.name) for data_set in m.data_sets),
        decisions=tuple(replace(d, first=prefix + d.first, second=prefix + d.second) for d in m.decisions),
    )


def _prefixed_surface(surface: BSplineSurface, prefix: str) -> BSplineSurface:
    pose = tuple(replace(part, data_set=prefix + part.data_set) for part in surface.covariance.pose)
    return replace(
        surface,
        name=prefix + surface.name,
        data_sets=tuple(prefix + name for name in surface.data_sets),
        covariance=replace(surface.covariance, pose=pose),
    )
