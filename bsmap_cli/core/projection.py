"""Projection of points onto a B-spline surface: the foot of the perpendicular, or the nearest point of the edge.

Start at the closest of a grid of samples, then Newton on both orthogonality conditions, Eq. (34-36). Other samples that
may lie above a nearer foot are tried, too, as long as they promise one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.basis import Surface
from bsmap_cli.core.descent import Feet, descend, dot
from bsmap_cli.core.pieces import Pieces, evaluate_pieces
from bsmap_cli.core.sampling import OFFSET, SampleGrid, Samples, sample_surface
from bsmap_cli.model import Array

EDGE_TOLERANCE = 1e-6
"""Metres that a point may overhang an edge of the surface and still count as on it."""
LONGEST_STEP = 1.0
"""Step at a time in diagonals of the cells at the start: longer ones leave its valley."""
STARTS, MORE_STARTS = 8, 24
"""Samples looked at for other starts, and where the last of them may lead to a nearer foot, too."""
BATCH = 16384
"""Points projected at a time."""


class Projection(NamedTuple):
    """Feet of points on a surface.

    u, v : (n,) parameters of the feet.  foot : (n, 3).  distance : (n,) metres from point to foot.
    on_surface : (n,) bool; False where the foot lies on the surface's edge and the distance is not perpendicular to it.
    """

    u: Array
    v: Array
    foot: Array
    distance: Array
    on_surface: NDArray[np.bool_]


def project(surface: Surface, points: Array, samples: Samples | None = None, within: float = np.inf) -> Projection:
    """Nearest points of a surface, Eq. (34-36).

    Parameters
    ----------
    points : (n, 3), in the frame of the surface.
    samples : from `sample_surface`, where they are at hand.
    within : metres; feet farther off are not sought to the end: they lie on the surface, but others may be nearer.

    Returns
    -------
    Projection, each array (n, ...).
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have shape {points.shape}, wanted (n, 3)")
    samples = sample_surface(surface) if samples is None else samples
    uv = np.empty((2, len(points)))
    for start in range(0, len(points), BATCH):
        part = slice(start, start + BATCH)
        uv[:, part] = _nearest_feet(samples, points[part], within)
    return _as_projection(samples.pieces, points, uv)


def _nearest_feet(samples: Samples, points: Array, within: float) -> Array:
    """Parameters (2, n) of the nearest feet."""
    limit = np.full(len(points), within**2)
    columns = np.ascontiguousarray(points.T)
    near = _Near(*samples.fine.nearest(points, STARTS))
    start = _start(samples.fine, near.sample[0])
    feet = descend(samples.pieces, columns, *start, limit)
    np.minimum(feet.squared, limit, out=feet.squared)
    rows, others = _all_other_starts(samples, points, near, feet)
    if len(rows):
        _keep_nearest(feet, rows, descend(samples.pieces, columns[:, rows], *others, feet.squared[rows]))
    return feet.uv


class _Near(NamedTuple):
    """Distances and numbers (k, n) of the samples nearest to points."""

    distance: Array
    sample: NDArray[np.intp]


class _Start(NamedTuple):
    """Parameters uv (2, n) at which descents start, and their longest steps (n,) in metres."""

    uv: Array
    longest: Array


def _start(grid: SampleGrid, index: NDArray[np.intp]) -> _Start:
    return _Start(grid.parameters(index), LONGEST_STEP * grid.reach[index])


def _floor(grid: SampleGrid, distance: Array, index: NDArray[np.intp]) -> Array:
    """Squared distance of the nearest foot that samples may lie above, an offset beside them."""
    return distance**2 - (OFFSET * grid.reach.take(index)) ** 2


def _all_other_starts(samples: Samples, points: Array, near: _Near, feet: Feet) -> tuple[NDArray[np.intp], _Start]:
    """Points (k,) and other starts for them among the samples at hand (`near`), and further ones where those end."""
    rows, starts = _other_starts(samples.fine, near, feet)
    found = [(rows, *starts)]
    # Where the last sample at hand could still lie above a nearer foot: more samples, then wider steps.
    left = np.flatnonzero(_floor(samples.fine, near.distance[-1], near.sample[-1]) < feet.squared)
    for grid, known, count in ((samples.fine, STARTS, MORE_STARTS), (samples.coarse, 0, STARTS)):
        if not len(left):
            break
        near = _Near._make(ranks[known:] for ranks in grid.nearest(points[left], count))
        here = Feet(feet.uv[:, left], feet.squared[left])
        rows, starts = _other_starts(grid, near, here)
        found.append((left[rows], *starts))
        left = left[_floor(grid, near.distance[-1], near.sample[-1]) < here.squared]
    rows, uv, longest = (np.concatenate(parts, axis=-1) for parts in zip(*found, strict=True))
    return rows, _Start(uv, longest)


def _other_starts(grid: SampleGrid, near: _Near, feet: Feet) -> tuple[NDArray[np.intp], _Start]:
    """Points (k,), and samples to start from again: apart from the foot found, from each other, and near enough."""
    promising = _floor(grid, near.distance, near.sample) < feet.squared
    promising &= grid.apart(near.sample, grid.closest(feet.uv))
    rows = np.flatnonzero(promising.any(axis=0))
    promising, index = promising.take(rows, axis=1), near.sample.take(rows, axis=1)
    for k in range(len(promising) - 1):
        promising[k + 1 :] &= grid.apart(index[k + 1 :], index[k]) | ~promising[k]
    rank, row = np.nonzero(promising)
    return rows[row], _start(grid, index[rank, row])


def _keep_nearest(feet: Feet, rows: NDArray[np.intp], others: Feet) -> None:
    """Put the nearest of other feet in the place of those of points `rows`, where they are nearer."""
    order = np.argsort(-others.squared, kind="stable")
    order = order[others.squared[order] < feet.squared[rows[order]]]
    # Of several values for one place the last one stays.
    feet.uv[:, rows[order]] = others.uv[:, order]
    feet.squared[rows[order]] = others.squared[order]


def _as_projection(pieces: Pieces, points: Array, uv: Array) -> Projection:
    u, v = uv
    foot = evaluate_pieces(pieces, u, v)[0]
    r = foot - points.T
    edge = np.flatnonzero((u <= 0.0) | (u >= 1.0) | (v <= 0.0) | (v >= 1.0))
    on_surface = np.ones(len(points), dtype=bool)
    on_surface[edge] = _overhang(pieces, r[:, edge], u[edge], v[edge]) <= EDGE_TOLERANCE
    return Projection(u, v, foot.T, np.sqrt(dot(r, r)), on_surface)


def _overhang(pieces: Pieces, r: Array, u: Array, v: Array) -> Array:
    """Metres (n,) by which points lie outside the edge on which their feet are, along the tangent across it."""
    _, Su, Sv = evaluate_pieces(pieces, u, v, 1)
    across_u = dot(r, Su) / np.maximum(np.sqrt(dot(Su, Su)), 1e-300)
    across_v = dot(r, Sv) / np.maximum(np.sqrt(dot(Sv, Sv)), 1e-300)
    sides = ((u <= 0.0, across_u), (u >= 1.0, -across_u), (v <= 0.0, across_v), (v >= 1.0, -across_v))
    return np.maximum.reduce([np.where(at, across, 0.0) for at, across in sides])
