"""Two faces compared where they overlap or touch: how far apart they lie, and how far their covariances allow."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from bsmap_cli.fit.heights import evaluate
from bsmap_cli.merge.bases import BasedFace, height_variances, normals, pose_variances
from bsmap_cli.merge.regions import Region
from bsmap_cli.model import Array, IntArray
from bsmap_cli.params import MergeParams

LARGEST_ANGLE = np.radians(25.0)
"""Between the base planes of faces that are compared at all; whether they agree is told by their heights."""


class Heights(NamedTuple):
    """Of one face's samples, those inside another face: their numbers (k,), how far they lie above it, metres, by which
    variances that differs from 0 by chance, and the variances (k,) of the other face alone, sensor part.
    """

    numbers: IntArray
    heights: Array
    variances: Array
    of_other: Array


class Pair(NamedTuple):
    """Two faces, by number, that overlap or touch.

    area : square metres that both have.  offset : metres, root mean square between them there, or at the border.
    distance : squared Mahalanobis distance of one degree of freedom, mean.  same : whether a data set has both.
    heights : where they overlap, of the first above the second, and the other way round.
    """

    first: int
    second: int
    area: float
    offset: float
    distance: float
    same: bool
    opposite: bool
    heights: tuple[Heights, Heights]


class Comparison(NamedTuple):
    """Faces to be compared.  reach : of each the region and what lies beside it within the gap."""

    faces: Sequence[BasedFace]
    reach: Sequence[Region]
    params: MergeParams


def prepared(faces: Sequence[BasedFace], params: MergeParams) -> Comparison:
    """Faces ready to be compared many times."""
    regions = [face.region for face in faces]
    reach = list(shapely.buffer(regions, params.gap, quad_segs=2)) if regions else []
    shapely.prepare(regions)
    shapely.prepare(reach)
    return Comparison(faces, reach, params)


def near(faces: Sequence[BasedFace], params: MergeParams) -> list[list[tuple[int, float]]]:
    """Of each face those whose boxes are near and whose planes are about parallel: numbers, and about square metres
    that the boxes share.
    """
    out: list[list[tuple[int, float]]] = [[] for _ in faces]
    if len(faces) < 2:
        return out
    low = np.array([face.samples.min(axis=0) for face in faces])
    high = np.array([face.samples.max(axis=0) for face in faces])
    ways = np.array([normals(face.field.base, face.samples[:1])[0] for face in faces])
    bent = np.array([face.round for face in faces])
    reach = max(params.distance, params.gap)
    boxes = shapely.box(low[:, 0], low[:, 1], high[:, 0], high[:, 1])
    wide = shapely.box(low[:, 0] - reach, low[:, 1] - reach, high[:, 0] + reach, high[:, 1] + reach)
    a, b = shapely.STRtree(boxes).query(wide)
    level = (low[a, 2] - reach <= high[b, 2]) & (low[b, 2] - reach <= high[a, 2])
    parallel = np.abs(np.sum(ways[a] * ways[b], axis=1)) > np.cos(LARGEST_ANGLE)
    kept = (a != b) & level & (bent[a] == bent[b]) & (bent[a] | parallel)
    a, b = a[kept], b[kept]
    shared = np.maximum(np.minimum(high[a], high[b]) - np.maximum(low[a], low[b]), 0.0)
    overlap = np.prod(np.sort(shared, axis=1)[:, 1:], axis=1)
    for one, other, area in zip(a.tolist(), b.tolist(), overlap.tolist(), strict=True):
        out[one].append((other, area))
    return out


def _turned(one: BasedFace, other: BasedFace) -> float:
    """+1 where the bases' normals point the same way at the middle of a face, -1 where they are turned round."""
    at = one.samples[:1] if one.round else one.samples.mean(axis=0)[None]
    return float(np.sign(np.sum(normals(one.field.base, at) * normals(other.field.base, at))))


class _Offsets(NamedTuple):
    """Of one face's samples that lie on another face or beside it: heights, variances, areas, whether on it; numbers,
    and variances of the other face alone.
    """

    heights: Array
    variances: Array
    areas: Array
    inside: NDArray[np.bool_]
    numbers: IntArray
    of_other: Array

    def overlap(self) -> Heights:
        """Of what lies on it, not at the border."""
        some = self.inside & (self.areas > 0.0)
        return Heights(self.numbers[some], self.heights[some], self.variances[some], self.of_other[some])


_NONE = np.zeros(0)
NOTHING = _Offsets(_NONE, _NONE, _NONE, np.zeros(0, dtype=bool), np.zeros(0, dtype=np.int64), _NONE)


def compare(comparison: Comparison, a: int, b: int) -> Pair | None:
    """Both compared where they overlap, else where they touch; None where they do neither within reach."""
    one, other = comparison.faces[a], comparison.faces[b]
    both = [_offsets(comparison, a, b), _offsets(comparison, b, a)]
    h, variance, areas, inside, *_ = (np.concatenate(parts) for parts in zip(*both, strict=True))
    # Where they overlap, what lies beside says no more.
    used = inside if np.any(inside & (areas > 0.0)) else np.ones(len(h), dtype=bool)
    if not len(h) or np.abs(h[used]).min() > 2.0 * comparison.params.distance:
        return None
    offset = float(np.sqrt(np.mean(h[used] ** 2)))
    distance = float(np.mean(h[used] ** 2 / variance[used]))
    same = bool(set(one.surface.data_sets) & set(other.surface.data_sets))
    looks = one.facing * other.facing * _turned(one, other)
    area = float(areas[inside].sum() / 2.0)
    return Pair(a, b, area, offset, distance, same, bool(looks < 0.0), (both[0].overlap(), both[1].overlap()))


def _offsets(comparison: Comparison, of: int, to: int) -> _Offsets:
    face, on, params = comparison.faces[of], comparison.faces[to], comparison.params
    local = on.field.base.local(face.samples)
    numbers = np.flatnonzero(shapely.contains_xy(comparison.reach[to], local[:, :2]))
    if not len(numbers):
        return NOTHING
    points, local = face.samples[numbers], local[numbers]
    uv = on.field.parameters(local)
    h = local[:, 2] - evaluate(on.field, uv)[0]
    of_other = height_variances(on.surface, on.field, uv)
    variance = face.variances[numbers] + of_other + 2.0 * params.flatness**2 + pose_variances(on, face, points)
    inside = np.asarray(shapely.contains_xy(on.region, local[:, :2]), dtype=bool)
    return _Offsets(h, variance, face.areas[numbers], inside, numbers, of_other)
