"""Surfaces of data sets -> one map: overlaps found, divided, fused and fitted again, method.md section 9."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import combinations

from bsmap_cli.errors import ParameterError
from bsmap_cli.merge.alignment import bring_together
from bsmap_cli.merge.faces import merge_faces, no_faces
from bsmap_cli.merge.inputs import separate_faces, unite
from bsmap_cli.merge.joining import merge_pair
from bsmap_cli.merge.pairs import Overlap, find_overlap
from bsmap_cli.merge.patch import Patch, make_patch
from bsmap_cli.merge.surveys import Summed, sum_up
from bsmap_cli.model import Decision, Placement, SurfaceMap
from bsmap_cli.params import MergeParams
from bsmap_cli.track import Track, silent

__all__ = ["merge_surfaces"]

MERGINGS = 20
"""Most mergings for each surface of the input. Every one takes area off the map, so that the end comes in any case."""


@dataclass
class _Search:
    """Patches under their numbers, and what is known of their pairs.

    neighbours : of each patch, those with which it has an overlap that holds a rectangle.
    waiting : overlaps not yet merged nor refused.
    """

    params: MergeParams
    patches: dict[int, Patch]
    neighbours: dict[int, set[int]] = field(default_factory=dict)
    waiting: dict[tuple[int, int], Overlap] = field(default_factory=dict)
    decisions: list[Decision] = field(default_factory=list)
    tested: int = 0


def merge_surfaces(maps: Sequence[SurfaceMap], params: MergeParams, *, track: Track = silent) -> SurfaceMap:
    """Merge the surfaces of all maps wherever they show the same place and agree.

    Pairs are taken by the area of their overlap, largest first, until no pair is left that overlaps and agrees. Of a
    pair, one patch gives the shape; both are divided into the rectangle of the overlap and the rest around it, the two
    rectangles are fused into one surface, and the rests stay.

    Parameters
    ----------
    maps : surface maps in one frame `map` (with `align` each in its own), in any order; where names clash, those of
    the smaller map get a number in front.

    Returns
    -------
    SurfaceMap of all merged and all other patches, with a decision for every pair that meets. Trimmed surfaces (faces)
    are joined whole, see `merge.faces`.
    """
    placements: tuple[Placement, ...] = ()
    if params.align:
        if len(maps) < 2:
            raise ParameterError("align: one map alone can be laid over no other one")
        maps, placements = bring_together(maps, params, track=track)
    united, survey, survey_of_set, settled = unite(maps)
    surfaces, trimmed = separate_faces(united.surfaces)
    faces = merge_faces(trimmed, united.creases, survey, settled, params, track=track) if trimmed else no_faces()
    taken = {surface.name for surface in united.surfaces}
    search = _Search(params, dict(enumerate(make_patch(surface) for surface in surfaces)))
    search.neighbours = {number: set() for number in search.patches}
    _test(search, combinations(search.patches, 2))
    limit, mergings = MERGINGS * len(surfaces), 0
    while search.waiting and mergings < limit:
        track("merging surfaces", search.tested - len(search.waiting), search.tested)
        pair = max(search.waiting, key=lambda p: (search.waiting[p].area, -p[0], -p[1]))
        result = merge_pair(search.waiting.pop(pair), params, lambda root: _new_name(root, taken))
        search.decisions.append(result.decision)
        if result.patches is not None:
            mergings += 1
            _replace(search, pair, result.patches)
    track("merging surfaces", search.tested, search.tested)
    tested = {"pairs_tested": search.tested, "mergings": mergings, "pairs_left_at_limit": len(search.waiting)}
    notes = (tested if surfaces else {}) | faces.notes
    merged = tuple(patch.surface for patch in search.patches.values())
    decisions = (*united.decisions, *faces.decisions, *search.decisions)
    summed = Summed([*merged, *faces.surfaces], united.data_sets)
    if len(maps) > 1 and settled:
        summed = sum_up(*summed, survey_of_set)
    creases, corners = tuple(faces.creases), faces.corners
    return SurfaceMap(tuple(summed.surfaces), summed.data_sets, decisions, notes, creases, corners, placements)


def _test(search: _Search, pairs: Iterable[tuple[int, int]]) -> None:
    """Look for the overlaps of pairs: those to merge wait, refusals are decisions."""
    for a, b in pairs:
        search.tested += 1
        found = find_overlap(search.patches[a], search.patches[b], search.params)
        if isinstance(found, Overlap):
            search.waiting[a, b] = found
            search.neighbours[a].add(b)
            search.neighbours[b].add(a)
        elif found is not None:
            search.decisions.append(found)


def _replace(search: _Search, pair: tuple[int, int], new: Sequence[Patch]) -> None:
    """Put new patches in the place of a merged pair; they can overlap what the pair overlapped, and each other."""
    for gone in [key for key in search.waiting if set(key) & set(pair)]:
        del search.waiting[gone]
    others = sorted((search.neighbours[pair[0]] | search.neighbours[pair[1]]) & search.patches.keys() - set(pair))
    following = max(search.patches) + 1
    for key in pair:
        del search.patches[key]
    fresh = range(following, following + len(new))
    for number, patch in zip(fresh, new, strict=True):
        search.patches[number] = patch
        search.neighbours[number] = set()
    _test(search, [(other, number) for number in fresh for other in others])
    _test(search, combinations(fresh, 2))


def _new_name(root: str, taken: set[str]) -> str:
    """Name of a new piece of a surface: the lowest number that is free."""
    number = 1
    while f"{root}/{number}" in taken:
        number += 1
    taken.add(f"{root}/{number}")
    return f"{root}/{number}"
