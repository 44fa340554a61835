"""Surveys over time: data sets of a new survey summed up with those of the map that saw the same, so that a map does
not grow where a place is scanned again.

The pose errors e_a of a data set of the map and e_b of a new one enter face f with weights w_fa and w_fb. Both become
one error with weight w_fa + w_fb and covariance

    sum_f (w_fa^2 C_a + w_fb^2 C_b) / sum_f (w_fa + w_fb)^2 ,

so that the variances of all faces together stay what they are. It is exact where the ratio of the weights is the same
for all faces, as it is where both saw the same; else an approximation. What the poses of a trajectory have in common is
summed up with the same weights; of all trajectories together the largest modes are kept.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from bsmap_cli.core.modes import LEAST_SHARE, LEVER, MOST_MODES, largest_positive
from bsmap_cli.model import Array, BSplineSurface, DataSet, PosePart

NEAR = 1.0
"""Metres between the centres of data sets that are summed up, at most."""
ALIKE = 0.7
"""Least likeness of the shares that two data sets have in what their surveys tell of the faces that both saw: 1 where
they are proportional, 0 where no face has both (Bhattacharyya's coefficient)."""
SHARED = 0.5
"""Of a data set's shares, how much must be in faces that both surveys saw."""


class Summed(NamedTuple):
    """Surfaces and data sets of the map."""

    surfaces: list[BSplineSurface]
    data_sets: tuple[DataSet, ...]


def sum_up(surfaces: Sequence[BSplineSurface], data_sets: Sequence[DataSet], survey: Mapping[str, int]) -> Summed:
    """Sum up each data set of a later survey with one of the map that saw the same, where there is one.

    survey : of each data set by its name, 0 for those of the map.
    """
    parts = {part.data_set: part for surface in surfaces for part in surface.covariance.pose}
    known = [d for d in data_sets if survey[d.name] == 0 and d.name in parts]
    into: dict[str, str] = {}
    for number in sorted({n for n in survey.values() if n > 0}):
        new = [d for d in data_sets if survey[d.name] == number and d.name in parts]
        into |= _partners(known, new, parts, _weights(surfaces))
    sums = with_common_modes(_summed_parts(surfaces, parts, into))
    by_name = {d.name: d for d in data_sets}
    for gone, kept in into.items():
        by_name[kept] = replace(by_name[kept], points=by_name[kept].points + by_name.pop(gone).points)
    return Summed([_renamed(surface, sums, into) for surface in surfaces], tuple(by_name.values()))


def _weights(surfaces: Sequence[BSplineSurface]) -> dict[str, Array]:
    """Of each data set its weights (n,) in all surfaces."""
    out: dict[str, Array] = {}
    for number, surface in enumerate(surfaces):
        for part in surface.covariance.pose:
            out.setdefault(part.data_set, np.zeros(len(surfaces)))[number] += part.weight
    return out


def _partners(
    known: Sequence[DataSet], new: Sequence[DataSet], parts: Mapping[str, PosePart], weights: Mapping[str, Array]
) -> dict[str, str]:
    """Of new data sets, by name, the one of the map that saw the same; each of the map has one of a survey at most."""
    alike = np.zeros((len(new), len(known)))
    of_known, of_new = (_shares(some, weights) for some in (known, new))
    shared = (np.sum([*of_known.values()], axis=0) > 0.0) & (np.sum([*of_new.values()], axis=0) > 0.0)
    for i, b in enumerate(new):
        for j, a in enumerate(known):
            way = float(np.linalg.norm(parts[a.name].centre - parts[b.name].centre))
            if a.movement == b.movement and way <= NEAR:
                alike[i, j] = _likeness(of_known[a.name], of_new[b.name], shared)
    rows, columns = linear_sum_assignment(alike, maximize=True)
    chosen = zip(rows.tolist(), columns.tolist(), strict=True)
    return {new[i].name: known[j].name for i, j in chosen if alike[i, j] >= ALIKE}


def _shares(data_sets: Sequence[DataSet], weights: Mapping[str, Array]) -> dict[str, Array]:
    """Of data sets of one survey, by name, the shares (n,) that they have in what it tells of each face."""
    mine = {d.name: np.maximum(weights[d.name], 0.0) for d in data_sets}
    whole = np.sum([*mine.values()], axis=0)
    return {name: np.divide(w, whole, out=np.zeros_like(w), where=whole > 0.0) for name, w in mine.items()}


def _likeness(p: Array, q: Array, shared: NDArray[np.bool_]) -> float:
    """Likeness of two data sets by their shares (n,), in the faces that both surveys saw; 0 where these are few."""
    both = p[shared].sum(), q[shared].sum()
    if both[0] < SHARED * p.sum() or both[1] < SHARED * q.sum() or not all(both):
        return 0.0
    return float(np.sqrt(p * q)[shared].sum() / np.sqrt(both[0] * both[1]))


class Sum(NamedTuple):
    """A pose part with what it has in common with others, by trajectory."""

    part: PosePart
    modes: dict[str, Array]


def _summed_parts(
    surfaces: Sequence[BSplineSurface], parts: Mapping[str, PosePart], into: Mapping[str, str]
) -> dict[str, Sum]:
    """Centre, covariance and modes of all data sets that stay; the weights are left out."""
    weights = _weights(surfaces)
    out = {}
    for kept in sorted(set(parts) - set(into)):
        names = [kept, *sorted(gone for gone, name in into.items() if name == kept)]
        totals = np.array([weights[name].sum() for name in names])
        centre = totals @ np.array([parts[name].centre for name in names]) / totals.sum()
        whole = np.sum([weights[name] for name in names], axis=0)
        covariance, modes = np.zeros((3, 3)), dict[str, Array]()
        for name in names:
            part, share = parts[name], np.linalg.norm(weights[name]) / np.linalg.norm(whole)
            T = share * moved_centre(centre - part.centre)
            covariance += T @ part.covariance @ T.T
            if part.modes is not None:
                before = modes.get(part.trajectory, np.zeros(part.modes.shape))
                modes[part.trajectory] = before + T @ part.modes
        out[kept] = Sum(PosePart(kept, centre, covariance, 0.0), modes)
    return out


def with_common_modes(sums: Mapping[str, Sum]) -> dict[str, PosePart]:
    """Pose parts, the modes of all trajectories made those of one; what the largest of them do not hold becomes their
    own, as it does of a single trajectory.

    The name of the one follows from what it holds.
    """
    counts = {trajectory: M.shape[1] for one in sums.values() for trajectory, M in one.modes.items()}
    if not counts:
        return {name: one.part for name, one in sums.items()}
    columns = [
        np.concatenate([one.modes.get(t, np.zeros((3, k))) for t, k in sorted(counts.items())], axis=1)
        for one in sums.values()
    ]
    scale = np.tile([1.0, 1.0, LEVER], len(columns))[:, None]
    U, s, _ = np.linalg.svd(scale * np.concatenate(columns), full_matrices=False)
    told = (s**2 > LEAST_SHARE * np.sum(s**2)) & (np.arange(len(s)) < MOST_MODES)
    modes = largest_positive(U[:, told] * s[told]) / scale
    trajectory = hashlib.sha256(modes.tobytes()).hexdigest()[:8]
    return {
        name: replace(one.part, modes=modes[3 * k : 3 * k + 3], trajectory=trajectory)
        for k, (name, one) in enumerate(sums.items())
    }


def moved_centre(way: Array) -> Array:
    """(3, 3) from an error about one centre to that about another one, `way` (2,) off."""
    x, y = way
    return np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])


def _renamed(surface: BSplineSurface, sums: Mapping[str, PosePart], into: Mapping[str, str]) -> BSplineSurface:
    pose: dict[str, PosePart] = {}
    for part in surface.covariance.pose:
        name = into.get(part.data_set, part.data_set)
        before = pose[name].weight if name in pose else 0.0
        pose[name] = replace(sums[name], weight=before + part.weight)
    covariance = replace(surface.covariance, pose=tuple(pose[name] for name in sorted(pose)))
    data_sets = tuple(sorted({into.get(name, name) for name in surface.data_sets}))
    return replace(surface, covariance=covariance, data_sets=data_sets)
