"""Projection of points onto a B-spline surface: the foot of the perpendicular, or the nearest point of the edge.

Start at the closest of a grid of samples, then Newton on both orthogonality conditions, Eq. (34-36), for all points at
once, safeguarded: Gauss-Newton where the Hessian is not positive definite, halved steps where the distance grows, and
along an edge of the domain only the other parameter moves.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bsmap_cli.core.bspline import Surface, evaluate_grid, evaluate_surface
from bsmap_cli.core.knots import inner_knots
from bsmap_cli.model import Array

COINCIDENCE = 1e-9
"""Metres: a foot this near to its point, or a step this short, is the end."""
ZERO_COSINE = 1e-9
"""Cosine of the angle between the distance and a tangent that counts as perpendicular."""
EDGE_TOLERANCE = 1e-6
"""Metres that a point may overhang an edge of the surface and still count as on it."""
ITERATIONS = 40
OFFSET = 0.75
"""Share of a cell's diagonal by which a foot may lie beside its sample."""
STARTS = 8
"""Samples looked at for other starts."""
SECOND_STARTS = 3
"""Descents tried besides the first."""

SAMPLES = 128
"""Samples along either direction at which long spans stop being divided further."""


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


class SampleGrid(NamedTuple):
    """Points of a surface on a grid of parameters, dense enough that the closest of them mostly starts Newton right.

    u : (k,), v : (l,) parameters of the grid.  tree : of its k l points, v fastest.
    reach : (k l,) metres, diagonal of the widest cell around each sample.
    clearance : (k l,) metres to the nearest sample that is not one of the eight neighbours.
    """

    u: Array
    v: Array
    tree: cKDTree
    reach: Array
    clearance: Array


class Samples(NamedTuple):
    """Fine samples of a surface, and every third of them."""

    fine: SampleGrid
    coarse: SampleGrid

    @property
    def tree(self) -> cKDTree:
        """Of the fine samples, for neighbours of other kinds."""
        return self.fine.tree

    @property
    def reach(self) -> Array:
        """(m,) metres, diagonal of the widest cell around each fine sample."""
        return self.fine.reach


def sample_surface(surface: Surface) -> Samples:
    """Samples of a surface; make them once where many batches are projected on the same surface."""
    spans = [
        _span_lengths(surface.knots_u, surface.degree_u, surface.control_points),
        _span_lengths(surface.knots_v, surface.degree_v, np.swapaxes(surface.control_points, 0, 1)),
    ]
    spacing = max(lengths.sum() for _, lengths in spans) / SAMPLES
    u = _divide(*spans[0], spacing, surface.degree_u)
    v = _divide(*spans[1], spacing, surface.degree_v)
    points = evaluate_grid(surface, u, v)
    i, j = _every_third(len(u)), _every_third(len(v))
    return Samples(_sample_grid(u, v, points), _sample_grid(u[i], v[j], points[np.ix_(i, j)]))


def _every_third(count: int) -> NDArray[np.intp]:
    return np.unique(np.append(np.arange(0, count, 3), count - 1))


def _sample_grid(u: Array, v: Array, points: Array) -> SampleGrid:
    legs = [np.linalg.norm(np.diff(points, axis=axis), axis=2) for axis in (0, 1)]
    widest_u = np.maximum(np.pad(legs[0], ((1, 0), (0, 0))), np.pad(legs[0], ((0, 1), (0, 0))))
    widest_v = np.maximum(np.pad(legs[1], ((0, 0), (1, 0))), np.pad(legs[1], ((0, 0), (0, 1))))
    flat = points.reshape(-1, 3)
    tree = cKDTree(flat, balanced_tree=False, compact_nodes=False)
    distance, near = _nearest(tree, flat, 10)
    # Where the nine nearest are all neighbours, the distance to the tenth is a lower bound.
    distance[:, :-1][~_apart(near[:, :-1], np.arange(len(flat))[:, None], len(v), len(flat))] = np.inf
    clearance = distance.min(axis=1)
    return SampleGrid(u, v, tree, np.hypot(widest_u, widest_v).ravel(), clearance)


def _nearest(tree: cKDTree, points: Array, k: int) -> tuple[Array, NDArray[np.intp]]:
    """Distances and indices of the k nearest: (n,) for k = 1, (n, k) for more; index n_samples where there are less."""
    distance, index = tree.query(points, k=k)
    return np.asarray(distance), np.asarray(index)


def _apart(first: NDArray[np.intp], second: NDArray[np.intp], width: int, count: int) -> NDArray[np.bool_]:
    """True where two samples are not neighbours on the grid; an index of `count` (no sample) is never apart."""
    rows, columns = np.abs(first // width - second // width), np.abs(first % width - second % width)
    return (np.maximum(rows, columns) > 1) & (first < count)


def _span_lengths(knots: Array, degree: int, control_points: Array) -> tuple[Array, Array]:
    """Ends (k + 1,) of the spans and their lengths (k,), metres.

    By the control polygons, of which each leg counts with the longest over the other direction.
    """
    ends = np.unique(np.concatenate([[0.0], inner_knots(knots, degree), [1.0]]))
    legs = np.linalg.norm(np.diff(control_points, axis=0), axis=2).max(axis=1)
    along = np.concatenate([[0.0], np.cumsum(legs)])
    greville = np.array([knots[i + 1 : i + 1 + degree].mean() for i in range(len(along))])
    return ends, np.diff(np.interp(ends, greville, along))


def _divide(ends: Array, lengths: Array, spacing: float, least: int) -> Array:
    """Parameters that divide each span into equal parts of at most `spacing`, and `least` of them."""
    parts = np.maximum(np.ceil(lengths / max(spacing, 1e-300)).astype(int), least)
    steps = [np.linspace(a, b, k, endpoint=False) for a, b, k in zip(ends[:-1], ends[1:], parts, strict=True)]
    return np.concatenate([*steps, [1.0]])


def project(surface: Surface, points: Array, samples: Samples | None = None) -> Projection:
    """Nearest points of a surface, Eq. (34-36).

    Parameters
    ----------
    points : (n, 3), in the frame of the surface.
    samples : from `sample_surface`, where they are at hand.

    Returns
    -------
    Projection, each array (n, ...).
    """
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points have shape {points.shape}, wanted (n, 3)")
    fine, coarse = sample_surface(surface) if samples is None else samples
    start_distance, start = _nearest(fine.tree, points, 1)
    found = _descend(surface, points, *_parameters(fine, start))
    distance = np.sqrt(_squared(found.jets[0] - points))
    room = np.maximum(fine.clearance[start] - start_distance, 0.0)
    doubtful = np.flatnonzero(room**2 - (OFFSET * fine.reach[start]) ** 2 < distance**2)
    for grid in (fine, coarse):
        _try_other_starts(surface, points, grid, doubtful, found)
    return _as_projection(surface, points, found)


class _State(NamedTuple):
    """Parameters (2, n) and jets (6, n, 3) S ... S_vv there; changed in place."""

    uv: Array
    jets: Array


def _descend(surface: Surface, points: Array, u: Array, v: Array) -> _State:
    """Newton from (u, v), all points at once; a point leaves the iteration when it has met a criterion."""
    uv = np.stack([u, v])
    state = _State(uv, evaluate_surface(surface, u, v, 2))
    active = np.arange(len(points))
    step, fresh = np.zeros((2, len(points))), np.ones(len(points), dtype=bool)
    for _ in range(ITERATIONS):
        jets, r = state.jets[:, active], state.jets[0, active] - points[active]
        moved = fresh[active]
        newton, done = _newton_step(jets[:, moved], r[moved], state.uv[:, active[moved]])
        step[:, active[moved]] = newton
        finished = np.zeros(len(active), dtype=bool)
        finished[moved] = done
        target = np.clip(state.uv[:, active] + step[:, active], 0.0, 1.0)
        delta = target - state.uv[:, active]
        shift = np.linalg.norm(delta[0, :, None] * jets[1] + delta[1, :, None] * jets[2], axis=1)
        going = ~finished & (shift > COINCIDENCE)
        active, target, squared = active[going], target[:, going], _squared(r[going])
        if not len(active):
            break
        trial = evaluate_surface(surface, target[0], target[1], 2)
        better = _squared(trial[0] - points[active]) < squared
        state.uv[:, active[better]] = target[:, better]
        state.jets[:, active[better]] = trial[:, better]
        fresh[active] = better
        step[:, active[~better]] *= 0.5
    return state


def _squared(r: Array) -> Array:
    return np.einsum("nk,nk->n", r, r)


def _newton_step(jets: Array, r: Array, uv: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Step (2, n) and whether the criteria of the paper hold already: coincidence, or zero cosine both ways.

    Minimises |S - Q|^2 / 2: gradient (f, g) and Hessian J of Eq. (35-36). At an edge that the gradient pushes against,
    the parameter across it stays and the step along it is Newton's for one variable.
    """
    _, Su, Sv, Suu, Suv, Svv = jets
    f, g = _dot(r, Su), _dot(r, Sv)
    a, b, c = _squared(Su), _dot(Su, Sv), _squared(Sv)  # Gauss-Newton part
    held_u = ((uv[0] <= 0.0) & (f > 0)) | ((uv[0] >= 1.0) & (f < 0))
    held_v = ((uv[1] <= 0.0) & (g > 0)) | ((uv[1] >= 1.0) & (g < 0))
    distance = np.sqrt(_squared(r))
    perpendicular_u = held_u | (np.abs(f) <= ZERO_COSINE * distance * np.sqrt(a))
    perpendicular_v = held_v | (np.abs(g) <= ZERO_COSINE * distance * np.sqrt(c))
    done = (distance <= COINCIDENCE) | (perpendicular_u & perpendicular_v)

    huu, huv, hvv = a + _dot(r, Suu), b + _dot(r, Suv), c + _dot(r, Svv)
    convex = (huu > 0) & (hvv > 0) & (huu * hvv - huv**2 > 1e-6 * huu * hvv)
    huu, huv, hvv = np.where(convex, huu, a), np.where(convex, huv, b), np.where(convex, hvv, c)
    # A little damping keeps Gauss-Newton defined where a tangent vanishes (a pole) or both are parallel.
    damping = np.where(convex, 0.0, 1e-9 * (a + c)) + 1e-300
    huu, hvv = huu + damping, hvv + damping
    huv = np.where(held_u | held_v, 0.0, huv)
    determinant = huu * hvv - huv**2
    du = np.where(held_u, 0.0, (huv * g - hvv * f) / determinant)
    dv = np.where(held_v, 0.0, (huv * f - huu * g) / determinant)
    return np.stack([du, dv]), done


def _dot(a: Array, b: Array) -> Array:
    return np.einsum("nk,nk->n", a, b)


def _parameters(samples: SampleGrid, index: NDArray[np.intp]) -> tuple[Array, Array]:
    return samples.u[index // len(samples.v)], samples.v[index % len(samples.v)]


def _try_other_starts(
    surface: Surface, points: Array, samples: SampleGrid, doubtful: NDArray[np.intp], found: _State
) -> None:
    """Descend again from samples that may lie above a nearer foot than the one found; keep the nearer.

    The foot under a sample at distance d can be as near as sqrt(d^2 - offset^2), its offset a share of the cell.
    """
    if not len(doubtful):
        return
    count = len(samples.reach)
    distance, near = _nearest(samples.tree, points[doubtful], min(STARTS, count))
    u, v = found.uv[:, doubtful]
    here = np.searchsorted((samples.u[1:] + samples.u[:-1]) / 2, u) * len(samples.v)
    here += np.searchsorted((samples.v[1:] + samples.v[:-1]) / 2, v)
    reach = np.append(samples.reach, 0.0)[near]
    best = _squared(found.jets[0, doubtful] - points[doubtful])[:, None]
    promising = _apart(near, here[:, None], len(samples.v), count) & (distance**2 - (OFFSET * reach) ** 2 < best)
    for _ in range(SECOND_STARTS):
        rows = np.flatnonzero(promising.any(axis=1))
        if not len(rows):
            return
        column = promising[rows].argmax(axis=1)
        chosen = near[rows, column]
        promising[rows] &= _apart(near[rows], chosen[:, None], len(samples.v), count)
        _keep_nearer(surface, points, doubtful[rows], _parameters(samples, chosen), found)


def _keep_nearer(
    surface: Surface, points: Array, which: NDArray[np.intp], start: tuple[Array, Array], found: _State
) -> None:
    other = _descend(surface, points[which], *start)
    nearer = _squared(other.jets[0] - points[which]) < _squared(found.jets[0, which] - points[which])
    found.uv[:, which[nearer]] = other.uv[:, nearer]
    found.jets[:, which[nearer]] = other.jets[:, nearer]


def _as_projection(surface: Surface, points: Array, found: _State) -> Projection:
    u, v = found.uv
    foot, Su, Sv = found.jets[0], found.jets[1], found.jets[2]
    r = foot - points
    distance = np.sqrt(_squared(r))
    # Overhang: how far the point lies outside an edge, measured along the tangent.
    across_u = _dot(r, Su) / np.maximum(np.linalg.norm(Su, axis=1), 1e-300)
    across_v = _dot(r, Sv) / np.maximum(np.linalg.norm(Sv, axis=1), 1e-300)
    overhang = np.maximum.reduce(
        [
            np.where(u <= 0.0, across_u, 0.0),
            np.where(u >= 1.0, -across_u, 0.0),
            np.where(v <= 0.0, across_v, 0.0),
            np.where(v >= 1.0, -across_v, 0.0),
        ]
    )
    return Projection(u, v, foot, distance, overhang <= EDGE_TOLERANCE)
