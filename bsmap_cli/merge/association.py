"""Which faces of different data sets are one and the same: pairs that agree, joined strongest first."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import shapely
from scipy.stats import chi2

from bsmap_cli.fit.heights import evaluate
from bsmap_cli.merge.planar import PlanarFace, height_variances, pose_variances
from bsmap_cli.model import Array, Decision
from bsmap_cli.params import MergeParams

LARGEST_ANGLE = np.radians(25.0)
"""Between the base planes of faces that are compared at all; whether they agree is told by their heights."""
FAR_OFF = 4.0
"""Times the gate: faces of different data sets that are farther apart never come into one group by way of others."""


SIGNIFICANT = 0.99999
"""Share of the pairs that did not move for which an offset is not taken for a movement between two surveys."""
COVERED = 0.5
"""Share of the smaller of two faces that the other one covers, from which on they are taken for the same thing."""


class Pair(NamedTuple):
    """Two faces, by number, that overlap or touch.

    area : square metres that both have.  offset : metres, root mean square between them there, or at the border.
    distance : squared Mahalanobis distance of one degree of freedom, mean.  same : whether a data set has both.
    """

    first: int
    second: int
    area: float
    offset: float
    distance: float
    same: bool
    opposite: bool


def associate(
    faces: Sequence[PlanarFace], survey: Mapping[str, int], params: MergeParams
) -> tuple[list[list[int]], list[Decision]]:
    """Groups of faces, each one physical face, and decisions: of each joining, and of two groups why they stay apart.

    Pairs of the same data set are never joined directly, and no two groups that hold such a pair at an offset.

    Parameters
    ----------
    survey : number of the survey that each surface stems from, by name.
    """
    gate = float(chi2.ppf(params.gate, 1))
    pairs = [pair for a, b in _near(faces, params) if (pair := _compare(faces, a, b, params)) is not None]
    group = list(range(len(faces)))
    members: dict[int, list[int]] = {number: [number] for number in group}
    apart: dict[int, dict[int, Pair]] = {number: {} for number in group}
    for pair in pairs:
        if pair.opposite or pair.offset > params.distance or pair.distance > gate * (1.0 if pair.same else FAR_OFF):
            apart[pair.first][pair.second] = apart[pair.second][pair.first] = pair
    joined, refused = [], []
    for pair in sorted(pairs, key=lambda p: (-p.area, p.distance, p.first, p.second)):
        reason = _refusal(pair, gate, params)
        a, b = group[pair.first], group[pair.second]
        if reason is None and a != b:
            small, large = sorted((a, b), key=lambda k: len(members[k]))
            between = [p for m in members[small] for k, p in apart[m].items() if group[k] == large]
            if between:
                worst = between[0]
                one, other = (faces[k].surface.name for k in (worst.first, worst.second))
                reason = f"would join {one} and {other}, which lie apart"
            else:
                for m in members[small]:
                    group[m] = large
                members[large] += members.pop(small)
                joined.append(_decision(faces, pair, None))
        if reason is not None and (not pair.same or pair.opposite):
            refused.append((pair, reason))
    decisions = [*joined, *_refusals(faces, _with_moved(faces, refused, group, survey), group)]
    return [sorted(found) for found in sorted(members.values(), key=min)], decisions


def _with_moved(
    faces: Sequence[PlanarFace],
    refused: Sequence[tuple[Pair, str]],
    group: Sequence[int],
    survey: Mapping[str, int],
) -> list[tuple[Pair, str]]:
    """Refusals, those first and with a reason of their own where something moved: two faces that cover each other at a
    significant offset, of which each survey saw but one.
    """
    least = float(chi2.ppf(SIGNIFICANT, 1))
    surveys: dict[int, set[int]] = defaultdict(set)
    for number, face in enumerate(faces):
        surveys[group[number]].add(survey[face.surface.name])
    moved, others = [], []
    for pair, reason in refused:
        covered = pair.area > COVERED * min(faces[pair.first].area, faces[pair.second].area)
        apart = surveys[group[pair.first]].isdisjoint(surveys[group[pair.second]])
        if covered and apart and not pair.opposite and pair.distance > least:
            moved.append((pair, "it moved between two surveys"))
        else:
            others.append((pair, reason))
    return [*moved, *others]


def _refusals(faces: Sequence[PlanarFace], refused: Sequence[tuple[Pair, str]], group: Sequence[int]) -> list[Decision]:
    """Of each two groups (or within one) the refusal of the strongest pair, and of how many pairs it speaks."""
    between: dict[tuple[int, int], list[tuple[Pair, str]]] = defaultdict(list)
    for pair, reason in refused:
        a, b = sorted((group[pair.first], group[pair.second]))
        between[a, b].append((pair, reason))
    out = []
    for found in between.values():
        strongest = _decision(faces, *found[0])
        out.append(replace(strongest, figures=strongest.figures | {"pairs": float(len(found))}))
    return out


def _refusal(pair: Pair, gate: float, params: MergeParams) -> str | None:
    if pair.opposite:
        return "they face opposite ways"
    if pair.offset > params.distance:
        return "they are farther apart than the distance allowed"
    if pair.distance > gate:
        return "their offset is outside the gate"
    return "they are of one data set" if pair.same else None


def _decision(faces: Sequence[PlanarFace], pair: Pair, reason: str | None) -> Decision:
    figures = {"area": pair.area, "offset": pair.offset, "squared_mahalanobis": pair.distance}
    names = faces[pair.first].surface.name, faces[pair.second].surface.name
    rounded = {key: float(f"{value:.4g}") for key, value in figures.items()}
    if reason is None:
        return Decision(*names, "merged", "the same face", rounded)
    return Decision(*names, "refused", reason, rounded)


def _near(faces: Sequence[PlanarFace], params: MergeParams) -> list[tuple[int, int]]:
    """Pairs of numbers whose boxes are near and whose planes are about parallel, ascending."""
    if len(faces) < 2:
        return []
    low = np.array([face.samples.min(axis=0) for face in faces])
    high = np.array([face.samples.max(axis=0) for face in faces])
    normals = np.array([face.normal for face in faces])
    reach = max(params.distance, params.gap)
    boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    wide = shapely.box(low[:, 0] - reach, low[:, 1] - reach, high[:, 0] + reach, high[:, 1] + reach)
    a, b = shapely.STRtree(boxes).query(wide)
    level = (low[a, 2] - reach <= high[b, 2]) & (low[b, 2] - reach <= high[a, 2])
    parallel = np.abs(np.sum(normals[a] * normals[b], axis=1)) > np.cos(LARGEST_ANGLE)
    kept = (a < b) & level & parallel
    return sorted(zip(a[kept].tolist(), b[kept].tolist(), strict=True))


class _Offsets(NamedTuple):
    """Of one face's samples that lie on another face or beside it: heights, variances, areas, whether on it."""

    heights: Array
    variances: Array
    areas: Array
    inside: Array


def _compare(faces: Sequence[PlanarFace], a: int, b: int, params: MergeParams) -> Pair | None:
    """Both compared where they overlap, else where they touch; None where they do neither within reach."""
    one, other = faces[a], faces[b]
    both = [_offsets(one, other, params), _offsets(other, one, params)]
    h, variance, areas, inside = (np.concatenate(parts) for parts in zip(*both, strict=True))
    # Where they overlap, what lies beside says no more.
    used = inside > 0.0 if np.any((inside > 0.0) & (areas > 0.0)) else np.ones(len(h), dtype=bool)
    if not len(h) or np.abs(h[used]).min() > 2.0 * params.distance:
        return None
    offset = float(np.sqrt(np.mean(h[used] ** 2)))
    distance = float(np.mean(h[used] ** 2 / variance[used]))
    same = bool(set(one.surface.data_sets) & set(other.surface.data_sets))
    looks = one.facing * other.facing * np.sign(one.normal @ other.normal)
    area = float(areas[inside > 0.0].sum() / 2.0)
    return Pair(a, b, area, offset, distance, same, bool(looks < 0.0))


def _offsets(face: PlanarFace, on: PlanarFace, params: MergeParams) -> _Offsets:
    local = on.field.base.local(face.samples)
    reach = shapely.buffer(on.region, params.gap, quad_segs=2)
    near = shapely.contains_xy(reach, local[:, :2])
    if not near.any():
        return _Offsets(*np.zeros((4, 0)))
    points, local = face.samples[near], local[near]
    uv = on.field.parameters(local)
    h = local[:, 2] - evaluate(on.field, uv)[0]
    variance = face.variances[near] + height_variances(on.surface, on.field, uv) + 2.0 * params.flatness**2
    variance += pose_variances(on, face, points)
    inside = shapely.contains_xy(on.region, local[:, :2]).astype(float)
    return _Offsets(h, variance, face.areas[near], inside)
