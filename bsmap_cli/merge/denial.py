"""Faces that the other data sets deny: where they looked, they saw something else.

A fit of few beams, or beams on a step that it took for a bend, makes faces that are not there. Those that stay apart
would double what the others saw, and those that are joined would bend it. Only data sets of one survey are asked: what
is not the same in two surveys may have moved.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.gaussian import chi2_gate
from bsmap_cli.merge.bases import BasedFace
from bsmap_cli.merge.comparison import Heights, Pair
from bsmap_cli.model import Decision

SURE = 0.999
"""Share of the samples of true faces that are not denied."""
HALF = 0.5
"""Of what others saw of a face, how much they must deny for it to be none."""
REASON = "the other data sets saw something else there"


class _Said(NamedTuple):
    """What another face says about the samples of a face. sets : how many data sets saw it."""

    sets: int
    heights: Heights


def denied_faces(
    faces: Sequence[BasedFace], pairs: Sequence[Pair], survey: Mapping[str, int], distance: float
) -> dict[int, Decision]:
    """Numbers of the faces that are none, with the decisions that say so.

    Parameters
    ----------
    pairs : of faces that were compared.
    survey : number of the survey of each surface, by name; of those in a map already, which may show what moved, none.
    distance : metres from where on a face says nothing about another one.
    """
    said = _said(faces, pairs, survey)
    denied = {k: _denied(faces[k], some, distance) for k, some in sorted(said.items())}
    denied = {k: found for k, found in denied.items() if found.any()}
    gone = {k for k, found in denied.items() if _is_none(faces[k], said[k], found, distance)}
    return {k: _decision(faces[k], denied[k]) for k in sorted(gone)}


def _said(faces: Sequence[BasedFace], pairs: Sequence[Pair], survey: Mapping[str, int]) -> dict[int, list[_Said]]:
    out: dict[int, list[_Said]] = defaultdict(list)
    for pair in pairs:
        first, second = (faces[k].surface for k in (pair.first, pair.second))
        if not (pair.same or pair.opposite) and survey.get(first.name, -1) == survey.get(second.name, -2):
            out[pair.first].append(_Said(len(second.data_sets), pair.heights[0]))
            out[pair.second].append(_Said(len(first.data_sets), pair.heights[1]))
    return out


def _denied(face: BasedFace, said: Sequence[_Said], distance: float) -> NDArray[np.bool_]:
    """Which samples (n,) more data sets deny than confirm; of as many, those that know better."""
    gate = chi2_gate(SURE, 1)
    votes, surest = np.full(len(face.samples), -len(face.surface.data_sets)), np.full(len(face.samples), np.inf)
    for sets, told in said:
        near = np.abs(told.heights) < distance
        off = near & (told.heights**2 > gate * told.variances)
        votes[told.numbers] += sets * np.where(off, 1, np.where(near, -1, 0))
        surest[told.numbers[off]] = np.minimum(surest[told.numbers[off]], told.of_other[off])
    return (votes > 0) | ((votes == 0) & (surest < face.variances))


def _seen(face: BasedFace, said: Sequence[_Said], distance: float) -> NDArray[np.bool_]:
    """Which of the samples that are not at the border others saw."""
    seen = np.zeros(len(face.samples), dtype=bool)
    for one in said:
        seen[one.heights.numbers[np.abs(one.heights.heights) < distance]] = True
    return seen[face.areas > 0.0]


def _is_none(face: BasedFace, said: Sequence[_Said], denied: NDArray[np.bool_], distance: float) -> bool:
    """Whether others saw most of a face and deny most of that, or more of them deny its slope than confirm it.

    An offset alone, of a part, can be an error of pose.
    """
    seen = _seen(face, said, distance)
    if seen.mean() >= HALF and np.count_nonzero(denied) >= HALF * np.count_nonzero(seen):
        return True
    votes, better = -len(face.surface.data_sets), False
    for one in said:
        numbers, h, variance, of_other = (part[np.abs(one.heights.heights) < distance] for part in one.heights)
        if len(h):
            leans = float(np.mean((h - h.mean()) ** 2 / variance)) > chi2_gate(SURE, 1)
            votes += one.sets if leans else -one.sets
            better |= leans and bool(of_other.mean() < face.variances[numbers].mean())
    return votes > 0 or (votes == 0 and better)


def _decision(face: BasedFace, denied: NDArray[np.bool_]) -> Decision:
    figures = {"area": face.area, "denied": float(denied[face.areas > 0.0].mean())}
    rounded = {key: float(f"{value:.2g}") for key, value in figures.items()}
    return Decision(face.surface.name, "", "refused", REASON, rounded)
