"""Faces of the map from what they are joined of: outlines, creases and corners, surfaces with covariance and names."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.heights import HeightField, PlaneBase
from bsmap_cli.fit.surfaces import spline_over
from bsmap_cli.merge.bases import BasedFace
from bsmap_cli.merge.curves import FacePair
from bsmap_cli.merge.extent import trimmed
from bsmap_cli.merge.frames import Frame
from bsmap_cli.merge.information import Joined, Told, covariance_of
from bsmap_cli.merge.open_borders import fewer_vertices
from bsmap_cli.merge.outlines import creased_sides, member_of, outline, snapped
from bsmap_cli.merge.shapes import Shape, spline_shape
from bsmap_cli.merge.topology import Topology, find_topology
from bsmap_cli.merge.untangling import untangled
from bsmap_cli.model import Array, BSplineSurface, Crease, Residuals

JOINED = "face-"
"""Names of joined faces begin with it."""


class Group(NamedTuple):
    """Faces of data sets that are one: what they tell, and what they give together. None for a face on its own."""

    faces: list[BasedFace]
    frame: Frame | None
    told: list[Told]
    joined: Joined | None

    @property
    def field(self) -> HeightField:
        return self.joined.field if self.joined else self.faces[0].field


def assemble(
    groups: Sequence[Group], others: Sequence[BSplineSurface], creases: Sequence[Crease], gap: float
) -> tuple[list[BSplineSurface], list[Crease], Array]:
    """Surfaces, creases and corners (k, 3) of the map.

    Parameters
    ----------
    others : surfaces over other bases than planes and cylinders, each a face of the map by itself.
    creases : of the data sets.
    gap : metres between parts of a face, or between creases and corners, that are closed.
    """
    names = _names(groups, others)
    whole = [_surface(group, names[k]) for k, group in enumerate(groups)] + list(others)
    flat = [isinstance(group.field.base, PlaneBase) for group in groups] + [False] * len(others)
    shapes: dict[int, Shape] = {k: groups[k].field if flat[k] else spline_shape(s) for k, s in enumerate(whole)}
    number_of = {face.surface.name: number for number, group in enumerate(groups) for face in group.faces}
    number_of |= {surface.name: len(groups) + k for k, surface in enumerate(others)}
    surfaces = [[face.surface for face in group.faces] for group in groups] + [[surface] for surface in others]
    pairs = [_pair(crease, number_of) for crease in creases]
    members = [[snapped(member_of(s, pairs), k, shapes) for s in some] for k, some in enumerate(surfaces)]
    outlines: dict[int, Sequence[Array]] = {}
    for number, group in enumerate(groups):
        sets = [" ".join(surface.data_sets) for surface in surfaces[number]]
        if loops := outline(members[number], sets, group.field, gap):
            outlines[number] = loops
    outlines |= {number: members[number][0].corners for number in range(len(groups), len(surfaces))}
    sides = creased_sides(member for some in members for member in some)
    found = find_topology(outlines, sides, shapes, gap)
    made = []
    for number, rings in found.rings.items():
        simple = untangled(fewer_vertices(rings, shapes[number]), shapes[number])
        made.append(trimmed(whole[number], simple, shapes[number]))
    return made, _creases(found, names), found.corners


def _creases(found: Topology, names: Mapping[int, str]) -> list[Crease]:
    return [Crease((names[e.pair[0]], names[e.pair[1]]), e.points, e.corners) for e in found.edges]


def _pair(crease: Crease, number_of: Mapping[str, int]) -> FacePair | None:
    """Faces of the map that meet in a crease of a data set; None where it is none any more."""
    a, b = sorted(number_of.get(name, -1) for name in crease.surfaces)
    return (a, b) if 0 <= a < b else None


def _names(groups: Sequence[Group], others: Sequence[BSplineSurface]) -> dict[int, str]:
    """Faces on their own keep their name, and joined ones that of the largest that was joined before; others are
    numbered, the largest first.
    """
    out = {number: group.faces[0].surface.name for number, group in enumerate(groups)}
    out |= {len(groups) + k: surface.name for k, surface in enumerate(others)}
    joined = [number for number, group in enumerate(groups) if group.joined]
    joined.sort(key=lambda number: (-sum(face.area for face in groups[number].faces), number))
    taken = {face.surface.name for group in groups for face in group.faces} | {surface.name for surface in others}
    count = 0
    for number in joined:
        before = [face for face in groups[number].faces if face.surface.name.startswith(JOINED)]
        if before:
            out[number] = max(before, key=lambda face: face.area).surface.name
            continue
        count += 1
        while f"{JOINED}{count:03d}" in taken:
            count += 1
        out[number] = f"{JOINED}{count:03d}"
    return out


def _surface(group: Group, name: str) -> BSplineSurface:
    if group.joined is None:
        return group.faces[0].surface
    spline, covariance = spline_over(group.joined.field, *covariance_of(group.joined, group.told))
    data_sets = sorted({data_set for face in group.faces for data_set in face.surface.data_sets})
    residuals = _pooled([face.surface.residuals for face in group.faces])
    return BSplineSurface(name, tuple(data_sets), *spline, covariance, residuals)


def _pooled(residuals: Sequence[Residuals]) -> Residuals:
    """Of all data together: as they were to the faces of their own data sets, the percentile about."""
    counts = np.array([r.points for r in residuals], dtype=float)
    share = counts / counts.sum()
    mean, percentile = (float(share @ [getattr(r, name) for r in residuals]) for name in ("mean", "percentile_95"))
    rms = float(np.sqrt(share @ [r.rms**2 for r in residuals]))
    return Residuals(int(counts.sum()), mean, rms, percentile, max(r.maximum for r in residuals))
