"""Which faces of different data sets are one and the same: pairs that agree, joined strongest first."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

from bsmap_cli.core.gaussian import chi2_gate
from bsmap_cli.merge.bases import BasedFace
from bsmap_cli.merge.changes import MOVED
from bsmap_cli.merge.comparison import Pair, compare, near, prepared
from bsmap_cli.model import Decision
from bsmap_cli.params import MergeParams

FAR_OFF = 4.0
"""Times the gate: faces of different data sets that are farther apart never come into one group by way of others."""
COMPARED = 4
"""Faces of one group, those that overlap most, with which a further face is compared: the cost stays linear."""
SIGNIFICANT = 0.99999
"""Share of the pairs that did not move for which an offset is not taken for a movement between two surveys."""
MOVED_REASON = "it moved between two surveys"
COVERED = 0.5
"""Share of the smaller of two faces that the other one covers, from which on they are taken for the same thing."""


class _Groups(NamedTuple):
    """Faces grouped so far, by number.

    of : number of the group of each face.  members : of each group.  apart : of each face those that are not to come
    into its group, and why.
    """

    of: list[int]
    members: dict[int, list[int]]
    apart: list[dict[int, Pair]]


class Associated(NamedTuple):
    """Groups of faces, by number, each one physical face.

    decisions : of each joining, and of two groups why they stay apart.  pairs : that were compared.
    """

    groups: list[list[int]]
    decisions: list[Decision]
    pairs: list[Pair]


def associate(faces: Sequence[BasedFace], survey: Mapping[str, int], params: MergeParams) -> Associated:
    """Put together faces that are one.

    Pairs of the same data set are never joined directly, and no two groups that hold such a pair at an offset.

    Parameters
    ----------
    survey : number of the survey that each surface stems from, by name.
    """
    gate = chi2_gate(params.gate, 1)
    pairs, groups = _compared(faces, gate, params), _alone(len(faces))
    _keep_apart(groups, pairs, gate, params)
    joined, refused = [], []
    for pair in _strongest_first(pairs):
        before = groups.of[pair.first] == groups.of[pair.second]
        reason = _refusal(pair, gate, params) or _join(groups, pair, faces)
        if reason is None and not before:
            joined.append(_decision(faces, pair, None))
        elif reason is not None and (not pair.same or pair.opposite):
            refused.append((pair, reason))
    decisions = [*joined, *_refusals(faces, _with_moved(faces, refused, groups.of, survey), groups.of)]
    return Associated([sorted(found) for found in sorted(groups.members.values(), key=min)], decisions, pairs)


def _compared(faces: Sequence[BasedFace], gate: float, params: MergeParams) -> list[Pair]:
    """Pairs that met: each face, the largest first, against the few that overlap it most of each group so far."""
    groups, pairs = _alone(len(faces)), []
    order = sorted(range(len(faces)), key=lambda k: (-faces[k].area, k))
    neighbours, comparison = near(faces, params), prepared(faces, params)
    done = [False] * len(faces)
    for number in order:
        by_group: dict[int, list[tuple[float, int]]] = defaultdict(list)
        for other, overlap in neighbours[number]:
            if done[other]:
                by_group[groups.of[other]].append((-overlap, other))
        some = [other for found in by_group.values() for _, other in sorted(found)[:COMPARED]]
        met = [pair for other in sorted(some) if (pair := compare(comparison, *sorted((number, other)))) is not None]
        _keep_apart(groups, met, gate, params)
        for pair in _strongest_first(met):
            if _refusal(pair, gate, params) is None:
                _join(groups, pair, faces)
        done[number] = True
        pairs += met
    return pairs


def _alone(count: int) -> _Groups:
    return _Groups(list(range(count)), {number: [number] for number in range(count)}, [{} for _ in range(count)])


def _strongest_first(pairs: Sequence[Pair]) -> list[Pair]:
    return sorted(pairs, key=lambda p: (-p.area, p.distance, p.first, p.second))


def _keep_apart(groups: _Groups, pairs: Sequence[Pair], gate: float, params: MergeParams) -> None:
    for pair in pairs:
        if pair.opposite or pair.offset > params.distance or pair.distance > gate * (1.0 if pair.same else FAR_OFF):
            groups.apart[pair.first][pair.second] = groups.apart[pair.second][pair.first] = pair


def _join(groups: _Groups, pair: Pair, faces: Sequence[BasedFace]) -> str | None:
    """Put the groups of a pair together; the reason where they hold faces that are to stay apart."""
    a, b = groups.of[pair.first], groups.of[pair.second]
    if a == b:
        return None
    small, large = sorted((a, b), key=lambda k: len(groups.members[k]))
    for m in groups.members[small]:
        for k, worst in groups.apart[m].items():
            if groups.of[k] == large:
                one, other = (faces[number].surface.name for number in (worst.first, worst.second))
                return f"would join {one} and {other}, which lie apart"
    for m in groups.members[small]:
        groups.of[m] = large
    groups.members[large] += groups.members.pop(small)
    return None


def _with_moved(
    faces: Sequence[BasedFace],
    refused: Sequence[tuple[Pair, str]],
    group: Sequence[int],
    survey: Mapping[str, int],
) -> list[tuple[Pair, str]]:
    """Refusals, those first and with a reason of their own where something moved: two faces that cover each other at a
    significant offset, of which each survey saw but one.
    """
    least = chi2_gate(SIGNIFICANT, 1)
    surveys: dict[int, set[int]] = defaultdict(set)
    for number, face in enumerate(faces):
        surveys[group[number]].add(survey[face.surface.name])
    moved, others = [], []
    for pair, reason in refused:
        covered = pair.area > COVERED * min(faces[pair.first].area, faces[pair.second].area)
        apart = surveys[group[pair.first]].isdisjoint(surveys[group[pair.second]])
        if covered and apart and not pair.opposite and pair.distance > least:
            moved.append((pair, MOVED_REASON))
        else:
            others.append((pair, reason))
    return [*moved, *others]


def _refusals(faces: Sequence[BasedFace], refused: Sequence[tuple[Pair, str]], group: Sequence[int]) -> list[Decision]:
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


def _decision(faces: Sequence[BasedFace], pair: Pair, reason: str | None) -> Decision:
    # To 0.1 mm and a hundredth, and to two digits: every data set adds a score of decisions to a map.
    figures = {"area": pair.area, "offset": round(pair.offset, 4), "squared_mahalanobis": round(pair.distance, 2)}
    names = faces[pair.first].surface.name, faces[pair.second].surface.name
    rounded = {key: float(f"{value:.2g}") for key, value in figures.items()}
    if reason is None:
        return Decision(*names, "merged", "the same face", rounded)
    return Decision(*names, MOVED if reason == MOVED_REASON else "refused", reason, rounded)
