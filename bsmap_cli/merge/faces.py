"""Trimmed faces of data sets -> faces of the map, every physical face once."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import TensorSpline
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.fit.selection import Fitted
from bsmap_cli.fit.surfaces import spline_of
from bsmap_cli.merge.adjustment import Correction, adjust, moved, moved_crease, with_left_over
from bsmap_cli.merge.association import associate
from bsmap_cli.merge.curves import FacePair, onto, straight
from bsmap_cli.merge.extent import trimmed
from bsmap_cli.merge.information import Frame, Joined, Told, common_frame, covariance_of, join, tell
from bsmap_cli.merge.outlines import creased_sides, member_of, outline, snapped
from bsmap_cli.merge.planar import PlanarFace, is_planar, planar_face
from bsmap_cli.merge.topology import Topology, find_topology
from bsmap_cli.model import (
    Array,
    BSplineSurface,
    Crease,
    Decision,
    HeightCovariance,
    Residuals,
    TrimLoop,
)
from bsmap_cli.params import MergeParams
from bsmap_cli.track import Track, silent

JOINED = "face-"
"""Names of joined faces begin with it."""


class MergedFaces(NamedTuple):
    """Faces of the map, their creases and corners (k, 3), what was decided, and figures for the notes."""

    surfaces: list[BSplineSurface]
    creases: list[Crease]
    corners: Array
    decisions: list[Decision]
    notes: dict[str, float]


def no_faces() -> MergedFaces:
    """Of a map without trimmed surfaces."""
    return MergedFaces([], [], np.zeros((0, 3)), [], {})


class _Group(NamedTuple):
    """Faces of data sets that are one: what they tell, and what they give together. None for a face on its own."""

    faces: list[PlanarFace]
    frame: Frame | None
    told: list[Told]
    joined: Joined | None

    @property
    def field(self) -> HeightField:
        return self.joined.field if self.joined else self.faces[0].field


def merge_faces(
    surfaces: Sequence[BSplineSurface], creases: Sequence[Crease], params: MergeParams, *, track: Track = silent
) -> MergedFaces:
    """Join faces over planes that are one, trim them by what any data set saw, and join their creases.

    Twice: the faces that are joined first tell small corrections of the data sets' poses; with these taken away all
    are associated and joined again. Faces over other bases stay as they are, which a decision says.

    Parameters
    ----------
    surfaces : trimmed surfaces of all data sets.  creases : to which their trims refer.
    """
    surfaces = sorted(surfaces, key=_key)
    faces = [face for s in surfaces if is_planar(s) and (face := planar_face(s)) is not None]
    track("merging faces", 0, 2)
    groups = _groups(faces, associate(faces, params)[0], params)
    corrections = adjust([(group.told, group.joined) for group in groups if group.joined])
    track("merging faces", 1, 2)
    if corrections:
        by_name = {surface.name: surface for surface in surfaces}
        creases = [moved_crease(crease, by_name, corrections) for crease in creases]
        surfaces = [moved(surface, corrections) for surface in surfaces]
        faces = [face for s in surfaces if is_planar(s) and (face := planar_face(s)) is not None]
    gated = [face._replace(surface=with_left_over(face.surface, corrections)) for face in faces]
    numbers, decisions = associate(gated, params)
    groups = _groups(faces, numbers, params)
    planar = {face.surface.name for face in faces}
    others = [surface for surface in surfaces if surface.name not in planar]
    track("merging faces", 2, 2)
    made, lines, corners = _assemble(groups, others, creases, params)
    notes = {
        "faces_before": float(len(surfaces)),
        "faces_after": float(len(made)),
        "largest_correction": _largest(corrections),
    }
    return MergedFaces(made, lines, corners, [*decisions, *_left(others)], notes)


def _key(surface: BSplineSurface) -> tuple[float, ...]:
    """By shape, so that neither the order of the input nor names matter."""
    return tuple(np.round(surface.control_points.ravel(), 9).tolist())


def _largest(corrections: dict[str, Correction]) -> float:
    return max((float(np.linalg.norm(c.error[:2])) for c in corrections.values()), default=0.0)


def _left(others: Sequence[BSplineSurface]) -> list[Decision]:
    if not others:
        return []
    reason = "faces that are not over a plane stay as they are: joining them is not possible yet"
    return [Decision("", "", "refused", reason, {"faces": float(len(others))})]


def _groups(faces: Sequence[PlanarFace], numbers: Sequence[Sequence[int]], params: MergeParams) -> list[_Group]:
    out = []
    for members in numbers:
        some = [faces[number] for number in members]
        if len(some) == 1:
            out.append(_Group(some, None, [], None))
            continue
        frame = common_frame(some)
        told = [tell(face, frame, params.flatness) for face in some]
        out.append(_Group(some, frame, told, join(told, frame)))
    return out


def _assemble(
    groups: Sequence[_Group], others: Sequence[BSplineSurface], creases: Sequence[Crease], params: MergeParams
) -> tuple[list[BSplineSurface], list[Crease], Array]:
    """Surfaces, creases and corners of the map."""
    fields = {number: group.field for number, group in enumerate(groups)}
    number_of = {face.surface.name: number for number, group in enumerate(groups) for face in group.faces}
    number_of |= {surface.name: len(groups) + k for k, surface in enumerate(others)}
    names = _names(groups, others)
    pairs = [_pair(crease, number_of, fields) for crease in creases]
    members = [
        [snapped(member_of(face.surface, pairs), number, fields) for face in group.faces]
        for number, group in enumerate(groups)
    ]
    outlines = {}
    for number, group in enumerate(groups):
        sets = [" ".join(face.surface.data_sets) for face in group.faces]
        if loops := outline(members[number], sets, fields[number], params.gap):
            outlines[number] = loops
    sides = creased_sides(member for some in members for member in some)
    found = find_topology(outlines, sides, fields, params.gap)
    made = [
        trimmed(_surface(groups[number], names[number]), rings, fields[number]) for number, rings in found.rings.items()
    ]
    return [*made, *(_without_creases(surface) for surface in others)], _creases(found, names), found.corners


def _creases(found: Topology, names: Mapping[int, str]) -> list[Crease]:
    return [Crease((names[e.pair[0]], names[e.pair[1]]), e.points, e.corners) for e in found.edges]


def _pair(crease: Crease, number_of: dict[str, int], fields: dict[int, HeightField]) -> FacePair | None:
    """Faces of the map that meet in a crease of a data set; None where it is none any more."""
    a, b = sorted(number_of.get(name, -1) for name in crease.surfaces)
    if a < 0 or a == b or not {a, b} <= fields.keys():
        return None
    points = onto([fields[a], fields[b]], crease.points)
    return (a, b) if straight(points) else None


def _without_creases(surface: BSplineSurface) -> BSplineSurface:
    loops = (TrimLoop(loop.parameters, np.full(len(loop.creases), -1)) for loop in surface.trims)
    return replace(surface, trims=tuple(loops))


def _names(groups: Sequence[_Group], others: Sequence[BSplineSurface]) -> dict[int, str]:
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


def _surface(group: _Group, name: str) -> BSplineSurface:
    if group.joined is None:
        return group.faces[0].surface
    spline: TensorSpline = spline_of(Fitted(group.joined.field, group.joined.information, 0.0), ())[0]
    covariance: HeightCovariance = covariance_of(group.joined, group.told)
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
