"""Faces of the map from what they are joined of: outlines, creases and corners, surfaces with covariance and names."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np
import shapely

from bsmap_cli.fit.heights import HeightField, PlaneBase
from bsmap_cli.fit.surfaces import spline_over
from bsmap_cli.merge.bases import BasedFace, base_side, normals
from bsmap_cli.merge.curves import FacePair
from bsmap_cli.merge.extent import trimmed
from bsmap_cli.merge.frames import Frame
from bsmap_cli.merge.information import Joined, Told, covariance_of
from bsmap_cli.merge.layers import CLOSE, cut_back
from bsmap_cli.merge.open_borders import fewer_vertices
from bsmap_cli.merge.outlines import creased_sides, loops_around, member_of, seen, snapped
from bsmap_cli.merge.regions import Region
from bsmap_cli.merge.rims import along_rims
from bsmap_cli.merge.shapes import Shape, spline_shape
from bsmap_cli.merge.topology import Topology, find_topology
from bsmap_cli.merge.untangling import untangled
from bsmap_cli.model import Array, BSplineSurface, Crease, Residuals
from bsmap_cli.params import MergeParams

JOINED = "face-"
"""Names of joined faces begin with it."""

ROUNDS = 3
"""In which faces that lie on others are cut back: outlines move a little with each."""


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
    groups: Sequence[Group],
    others: Sequence[BSplineSurface],
    creases: Sequence[Crease],
    near: Collection[tuple[int, int]],
    params: MergeParams,
) -> tuple[list[BSplineSurface], list[Crease], Array]:
    """Surfaces, creases and corners (k, 3) of the map.

    Parameters
    ----------
    others : surfaces over other bases than planes and cylinders, each a face of the map by itself.
    creases : of the data sets.
    near : pairs of groups that are one layer where they lie on each other.
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
    fields = {number: group.field for number, group in enumerate(groups)}
    regions = {
        number: seen(members[number], [s.data_sets for s in surfaces[number]], field, params.gap)
        for number, field in fields.items()
    }
    outlines = _outlines({number: region.whole for number, region in regions.items()}, fields)
    outlines |= {number: members[number][0].corners for number in range(len(groups), len(surfaces))}
    sides = creased_sides(member for some in members for member in some)
    found = find_topology(outlines, sides, shapes, params.gap)
    for _ in range(ROUNDS):
        if not (cut := cut_back(found.rings, regions, fields, near, params.distance)):
            break
        outlines = {k: loops for k, loops in outlines.items() if k not in cut} | _outlines(cut, fields)
        found = find_topology(outlines, sides, shapes, params.gap)
    made = []
    for number, rings in found.rings.items():
        led = along_rims(rings, members[number], shapes[number])
        simple = untangled(fewer_vertices(led, shapes[number]), shapes[number])
        made.append(trimmed(whole[number], simple, shapes[number]))
    return made, _creases(found, names), found.corners


def _outlines(regions: Mapping[int, Region], fields: Mapping[int, HeightField]) -> dict[int, Sequence[Array]]:
    """Loops of the faces, by number, of which there is anything."""
    found = {number: loops_around(region, fields[number]) for number, region in regions.items()}
    return {number: loops for number, loops in found.items() if loops}


def neighbours(groups: Sequence[Group], survey: Mapping[str, int]) -> list[tuple[int, int]]:
    """Numbers of groups over planes that lie near each other, were seen by one survey, and not from opposite sides.

    survey : number of the survey of each surface, by name; of those in a map already, which may show what moved, none.
    """
    flat = [number for number, group in enumerate(groups) if isinstance(group.field.base, PlaneBase)]
    if not flat:
        return []
    samples = [np.concatenate([face.samples for face in groups[k].faces]) for k in flat]
    low, high = np.array([s.min(axis=0) for s in samples]), np.array([s.max(axis=0) for s in samples])
    boxes = shapely.box(low[:, 0] - CLOSE, low[:, 1] - CLOSE, high[:, 0] + CLOSE, high[:, 1] + CLOSE)
    a, b = shapely.STRtree(boxes).query(boxes)
    level = (low[a, 2] < high[b, 2] + CLOSE) & (low[b, 2] < high[a, 2] + CLOSE)
    names = [{face.surface.name for face in group.faces} & survey.keys() for group in groups]
    surveys = [{survey[name] for name in some} for some in names]
    looks = [_looks(group) for group in groups]
    found = ((flat[i], flat[j]) for i, j in zip(a[level].tolist(), b[level].tolist(), strict=True) if i < j)
    return [(i, j) for i, j in found if surveys[i] & surveys[j] and looks[i] @ looks[j] >= 0.0]


def _looks(group: Group) -> Array:
    """(3,) sum of the members' normals towards their sensors; 0 where they do not tell."""
    return np.sum([face.facing * normals(face.field.base, face.samples[:1])[0] for face in group.faces], axis=0)


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
    side = int(np.sign(_votes(group))) * base_side(spline, group.field.base)
    return BSplineSurface(name, tuple(data_sets), *spline, covariance, residuals, side=side)


def _votes(group: Group) -> float:
    """Square metres of members that sensors saw from where the joined base's normal points, less those of others."""
    base = group.field.base
    return float(
        sum(
            face.area * face.facing * np.sign(normals(base, at)[0] @ normals(face.field.base, at)[0])
            for face in group.faces
            for at in [face.samples[:1]]
        )
    )


def _pooled(residuals: Sequence[Residuals]) -> Residuals:
    """Of all data together: as they were to the faces of their own data sets, the percentile about."""
    counts = np.array([r.points for r in residuals], dtype=float)
    share = counts / counts.sum()
    mean, percentile = (float(share @ [getattr(r, name) for r in residuals]) for name in ("mean", "percentile_95"))
    rms = float(np.sqrt(share @ [r.rms**2 for r in residuals]))
    return Residuals(int(counts.sum()), mean, rms, percentile, max(r.maximum for r in residuals))
