"""Trimmed faces of data sets -> faces of the map, every physical face once."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.heights import PlaneBase
from bsmap_cli.merge.adjustment import Correction, adjust, moved, moved_crease, with_left_over
from bsmap_cli.merge.assembly import Group, assemble, neighbours
from bsmap_cli.merge.association import associate
from bsmap_cli.merge.bases import BasedFace, based_face, has_base
from bsmap_cli.merge.changes import MOVED, find_changes
from bsmap_cli.merge.denial import denied_faces
from bsmap_cli.merge.frames import common_frame
from bsmap_cli.merge.information import finest_spans, join, tell
from bsmap_cli.model import Array, BSplineSurface, Crease, Decision
from bsmap_cli.params import MergeParams
from bsmap_cli.track import Track, silent


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


def merge_faces(
    surfaces: Sequence[BSplineSurface],
    creases: Sequence[Crease],
    survey: Mapping[str, int],
    settled: Collection[int],
    params: MergeParams,
    *,
    track: Track = silent,
) -> MergedFaces:
    """Join faces that are one, over planes or cylinders, trim them by what any data set saw, and join their creases.

    Twice: the faces that are joined first tell small corrections of the data sets' poses; with these taken away all
    are associated and joined again. Faces over other bases stay as they are, which a decision says.

    Parameters
    ----------
    surfaces : trimmed surfaces of all data sets.  creases : to which their trims refer.
    survey : number of the survey that each surface stems from, by name.
    settled : numbers of those that are maps already.
    """
    surfaces = sorted(surfaces, key=_key)
    faces = [face for s in surfaces if has_base(s) and (face := based_face(s)) is not None]
    track("merging faces", 0, 2)
    groups = _groups(faces, associate(faces, survey, params).groups, params)
    # Pillars bear what the path errs by within a data set more than they tell of its pose (1 cm off in a corridor).
    corrections = adjust([(g.told, g.joined) for g in groups if g.joined and isinstance(g.field.base, PlaneBase)])
    track("merging faces", 1, 2)
    if corrections:
        by_name = {surface.name: surface for surface in surfaces}
        creases = [moved_crease(crease, by_name, corrections) for crease in creases]
        surfaces = [moved(surface, corrections) for surface in surfaces]
        faces = [face for s in surfaces if has_base(s) and (face := based_face(s)) is not None]
    gated = [face._replace(surface=with_left_over(face.surface, corrections)) for face in faces]
    numbers, decisions, pairs = associate(gated, survey, params)
    asked = {name: number for name, number in survey.items() if number not in settled}
    denied = denied_faces(gated, pairs, asked, params.distance)
    decisions += denied.values()
    left = ([k for k in members if k not in denied] for members in numbers)
    groups = _groups(faces, [members for members in left if members], params)
    based = {face.surface.name for face in faces}
    others = [surface for surface in surfaces if surface.name not in based]
    track("merging faces", 2, 2)
    told = {name for d in decisions if d.outcome == MOVED for name in (d.first, d.second)}
    decisions += find_changes([[f.surface for f in group.faces] for group in groups], surfaces, survey, told)
    made, lines, corners = assemble(groups, others, creases, neighbours(groups, asked), params)
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
    largest = max((float(np.linalg.norm(c.error[:2])) for c in corrections.values()), default=0.0)
    return float(f"{largest:.3g}")


def _left(others: Sequence[BSplineSurface]) -> list[Decision]:
    if not others:
        return []
    reason = "faces over neither a plane nor a cylinder stay as they are: joining them is not possible yet"
    return [Decision("", "", "refused", reason, {"faces": float(len(others))})]


def _groups(faces: Sequence[BasedFace], numbers: Sequence[Sequence[int]], params: MergeParams) -> list[Group]:
    out = []
    for members in numbers:
        some = [faces[number] for number in members]
        if len(some) == 1:
            out.append(Group(some, None, [], None))
            continue
        frame = common_frame(some)
        finest = finest_spans(some, frame)
        told = [tell(face, frame, params.flatness, finest) for face in some]
        out.append(Group(some, frame, told, join(told, frame, finest)))
    return out
