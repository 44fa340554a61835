"""Small corrections of the data sets' poses, from the faces that several of them share.

Each data set gets an error of pose with the covariance of its PosePart as prior: one of its own, and a share in the
modes that all data sets of its trajectory have in common. The heights of the joined faces are eliminated one face at a
time (Schur complement); what is left is a system of three unknowns a data set and those of the modes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from bsmap_cli.fit.heights import basis_matrix
from bsmap_cli.fit.smoothness import smoothness
from bsmap_cli.merge.information import ROBUST, Joined, Told, unit_errors
from bsmap_cli.model import Array, BSplineSurface, Crease, HeightCovariance, PosePart

ROUNDS = 3


class Correction(NamedTuple):
    """Error of pose of a data set as estimated. part : as before.  error : (3,) x, y metres, theta about its centre.

    covariance : (3, 3) of what is left of it.
    """

    part: PosePart
    error: Array
    covariance: Array


def adjust(groups: Sequence[tuple[Sequence[Told], Joined]]) -> dict[str, Correction]:
    """Corrections of all data sets that take part in a group of several faces."""
    parts = {part.data_set: part for told, _ in groups for one in told for part in one.pose}
    parts = {name: parts[name] for name in sorted(parts) if np.any(parts[name].covariance)}
    if not parts:
        return {}
    columns = _columns(parts)
    e = np.zeros(1 + max(max(some) for some in columns.values()))
    shares = [np.ones(len(told)) for told, _ in groups]
    for _ in range(ROUNDS):
        S, g = np.eye(len(e)), np.zeros(len(e))
        for (told, joined), share in zip(groups, shares, strict=True):
            used, reduced, right, _ = _reduced(told, joined, share, columns)
            S[np.ix_(used, used)] += reduced
            g[used] += right
        factor = cho_factor(S)
        e = cho_solve(factor, g)
        shares = [
            _shares(told, joined, share, columns, e) for (told, joined), share in zip(groups, shares, strict=True)
        ]
    left = cho_solve(factor, np.eye(len(e)))
    out = {}
    for name, part in parts.items():
        root, own = unit_errors(part), columns[name]
        out[name] = Correction(part, root @ e[own], root @ left[np.ix_(own, own)] @ root.T)
    return out


def _columns(parts: Mapping[str, PosePart]) -> dict[str, list[int]]:
    """Numbers of each data set's unknowns, in the order of `unit_errors`; a trajectory's modes are there once."""
    out, modes, size = {}, dict[str, list[int]](), 0
    for name, part in parts.items():
        out[name], size = list(range(size, size + 3)), size + 3
        if part.modes is not None:
            if part.trajectory not in modes:
                count = part.modes.shape[1]
                modes[part.trajectory], size = list(range(size, size + count)), size + count
            out[name] += modes[part.trajectory]
    return out


class _Rows(NamedTuple):
    """Whitened equations of one face told: N (k, n) by heights, G (k, p) by pose, y (k,) wanted; columns of G."""

    N: Array
    G: Array
    y: Array
    columns: list[int]


def _rows(one: Told, joined: Joined, place: Mapping[str, list[int]]) -> _Rows:
    N = one.root @ (one.carry @ basis_matrix(joined.field.knots, one.uv))
    used = sorted({column for part in one.pose for column in place.get(part.data_set, ())})
    at = {column: number for number, column in enumerate(used)}
    G, first = np.zeros((len(N), len(used))), 0
    for part in one.pose:
        width = 3 if part.modes is None else 3 + part.modes.shape[1]
        if part.data_set in place:
            # A mode has an effect by way of each data set of its trajectory.
            G[:, [at[column] for column in place[part.data_set]]] += one.by_pose[:, first : first + width]
        first += width
    return _Rows(N, one.root @ G, one.root @ one.heights, used)


def _reduced(
    told: Sequence[Told], joined: Joined, share: Array, place: Mapping[str, list[int]]
) -> tuple[list[int], Array, Array, Array]:
    """Columns used, Schur complement and right side after the heights are eliminated, heights without errors."""
    rows = [_rows(one, joined, place) for one in told]
    used = sorted({column for row in rows for column in row.columns})
    at = {column: number for number, column in enumerate(used)}
    n = joined.field.knots.size
    H, B, E = smoothness(joined.field.knots), np.zeros((n, len(used))), np.zeros((len(used), len(used)))
    by_heights, by_pose = np.zeros(n), np.zeros(len(used))
    for w, row in zip(share, rows, strict=True):
        columns = [at[column] for column in row.columns]
        H = H + w * row.N.T @ row.N
        B[:, columns] += w * row.N.T @ row.G
        E[np.ix_(columns, columns)] += w * row.G.T @ row.G
        by_heights += w * row.N.T @ row.y
        by_pose[columns] += w * row.G.T @ row.y
    factor = cho_factor(H)
    reduced = E - B.T @ cho_solve(factor, B)
    heights = cho_solve(factor, by_heights)
    return used, (reduced + reduced.T) / 2.0, by_pose - B.T @ heights, heights


def _shares(told: Sequence[Told], joined: Joined, share: Array, place: Mapping[str, list[int]], e: Array) -> Array:
    """Weights of the faces told by how far they are off at errors e (Huber)."""
    rows = [_rows(one, joined, place) for one in told]
    H = smoothness(joined.field.knots) + sum(w * r.N.T @ r.N for w, r in zip(share, rows, strict=True))
    wanted = [r.y - r.G @ e[r.columns] for r in rows]
    c = cho_solve(cho_factor(H), sum(w * r.N.T @ y for w, r, y in zip(share, rows, wanted, strict=True)))
    size = np.array([np.sqrt(np.mean((y - r.N @ c) ** 2)) for r, y in zip(rows, wanted, strict=True)])
    return np.asarray(np.minimum(1.0, ROBUST / np.maximum(size, 1e-12)))


def moved_points(points: Array, pose: Sequence[PosePart], corrections: Mapping[str, Correction]) -> Array:
    """Points (..., 3) in map of a surface with these pose parts, the errors taken away, each by its share."""
    out = np.array(points, dtype=float)
    for part in pose:
        if part.data_set in corrections:
            x, y, theta = part.weight * corrections[part.data_set].error
            out[..., 0] -= x - theta * (points[..., 1] - part.centre[1])
            out[..., 1] -= y + theta * (points[..., 0] - part.centre[0])
    return out


def moved(surface: BSplineSurface, corrections: Mapping[str, Correction]) -> BSplineSurface:
    """The surface with the errors of its data sets taken away; its pose parts keep their covariance."""
    covariance = surface.covariance
    points = moved_points(surface.control_points, covariance.pose, corrections)
    if isinstance(covariance, HeightCovariance):
        theta = sum(p.weight * corrections[p.data_set].error[2] for p in covariance.pose if p.data_set in corrections)
        c, s = np.cos(theta), np.sin(theta)
        turned = covariance.directions @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        covariance = replace(covariance, directions=turned)
    return replace(surface, control_points=points, covariance=covariance)


def with_left_over(surface: BSplineSurface, corrections: Mapping[str, Correction]) -> BSplineSurface:
    """The surface with the pose covariance that is left after the adjustment, for the gates of the second round."""
    pose = tuple(
        replace(part, covariance=corrections[part.data_set].covariance, modes=None)
        if part.data_set in corrections
        else part
        for part in surface.covariance.pose
    )
    return replace(surface, covariance=replace(surface.covariance, pose=pose))


def moved_crease(
    crease: Crease, surfaces: Mapping[str, BSplineSurface], corrections: Mapping[str, Correction]
) -> Crease:
    """The crease with the errors of its first surface's data sets taken away."""
    pose = surfaces[crease.surfaces[0]].covariance.pose
    return replace(crease, points=moved_points(crease.points, pose, corrections))
