"""Surfaces of data sets -> one map: overlaps found, divided, fused and fitted again, method.md section 9."""

from collections.abc import Sequence
from itertools import combinations

from bsmap_cli.merge.inputs import unite
from bsmap_cli.merge.pairs import Overlap, find_overlap, merge_pair
from bsmap_cli.merge.patch import Patch, make_patch
from bsmap_cli.model import Decision, SurfaceMap
from bsmap_cli.params import MergeParams
from bsmap_cli.track import Track, silent

MERGINGS = 20
"""Most mergings for each surface of the input. Every one takes area off the map, so that the end comes in any case."""


def merge_surfaces(maps: Sequence[SurfaceMap], params: MergeParams, *, track: Track = silent) -> SurfaceMap:
    """Merge the surfaces of all maps wherever they show the same place and agree.

    Pairs are taken by the area of their overlap, largest first, until no pair is left that overlaps and agrees. Of a
    pair, one patch keeps its shape; both are divided into the rectangle of the overlap and the rest around it, the two
    rectangles are fused into one surface, and the rests stay.

    Parameters
    ----------
    maps : surface maps in one frame `map`; names that clash get the number of their map in front.

    Returns
    -------
    SurfaceMap of all merged and all other patches, with a decision for every pair that meets.
    """
    surfaces, data_sets, former = unite(maps)
    patches = dict(enumerate(make_patch(surface) for surface in surfaces))
    taken = {surface.name for surface in surfaces}
    decisions: list[Decision] = []
    waiting: dict[tuple[int, int], Overlap] = {}
    tested = _search(patches, list(combinations(patches, 2)), params, waiting, decisions)
    limit, mergings = MERGINGS * len(surfaces), 0
    while waiting and mergings < limit:
        # Equal areas: the pair that stands first.
        pair = max(waiting, key=lambda p: (waiting[p].area, -p[0], -p[1]))
        track("merging surfaces", tested - len(waiting), tested)
        result = merge_pair(waiting.pop(pair), params, lambda root: _new_name(root, taken))
        decisions.append(result.decision)
        if result.patches is None:
            continue
        mergings += 1
        tested += _replace(patches, pair, result.patches, params, waiting, decisions)
    notes = {"pairs_tested": tested, "mergings": mergings, "pairs_left_at_limit": len(waiting)}
    merged = tuple(patch.surface for patch in patches.values())
    return SurfaceMap(merged, tuple(data_sets), (*former, *decisions), notes)


def _search(
    patches: dict[int, Patch],
    pairs: Sequence[tuple[int, int]],
    params: MergeParams,
    waiting: dict[tuple[int, int], Overlap],
    decisions: list[Decision],
) -> int:
    """Look for overlaps: those to merge go to `waiting`, refusals to `decisions`. Returns the number of pairs."""
    for a, b in pairs:
        found = find_overlap(patches[a], patches[b], params)
        if isinstance(found, Overlap):
            waiting[a, b] = found
        elif found is not None:
            decisions.append(found)
    return len(pairs)


def _replace(
    patches: dict[int, Patch],
    pair: tuple[int, int],
    new: Sequence[Patch],
    params: MergeParams,
    waiting: dict[tuple[int, int], Overlap],
    decisions: list[Decision],
) -> int:
    """Put new patches in the place of a merged pair and pair them with all others. Returns the number of new pairs."""
    for gone in [key for key in waiting if set(key) & set(pair)]:
        del waiting[gone]
    others = [key for key in patches if key not in pair]
    following = max(patches) + 1
    for key in pair:
        del patches[key]
    fresh = range(following, following + len(new))
    patches.update(zip(fresh, new, strict=True))
    pairs = [(a, b) for b in fresh for a in others] + list(combinations(fresh, 2))
    return _search(patches, pairs, params, waiting, decisions)


def _new_name(root: str, taken: set[str]) -> str:
    """Name of a new piece of a surface: the lowest number that is free."""
    number = 1
    while f"{root}/{number}" in taken:
        number += 1
    taken.add(f"{root}/{number}")
    return f"{root}/{number}"
