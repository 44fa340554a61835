"""Loop closing: places seen before, recognised by matching small maps of key scans, verified, smoothed over."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined, take
from bsmap_cli.model import Array
from bsmap_cli.slam import posegraph
from bsmap_cli.slam.candidates import far_candidates, near_candidates
from bsmap_cli.slam.matching import Target, make_target
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.recognition import recognised, witnesses
from bsmap_cli.slam.submaps import (
    SOURCE_KEYS,
    TARGET_KEYS,
    Search,
    agree,
    closure_edge,
    no_edges,
    register,
    revisit,
    small_map,
    source_map,
    target_map,
)
from bsmap_cli.slam.tracking import Tracking, match_noise
from bsmap_cli.track import Track

ROUNDS = 8
SPACING = 1.0
"""Metres of way between key scans for which loops are sought."""
WIDE_SPACING, WIDE_TURN = 3.0, 0.5
"""Metres of way between wide searches, and between candidates of a first look round; radians to both sides."""
KEPT = 64
"""Small maps that are kept for the next candidates, for neighbours ask for the same ones."""
SUPPORT_WAY = 10.0
"""A closure that moves the trajectory far needs another one, so many metres of way off at the most."""
WRONG = 25.0
"""Squared Mahalanobis distance beyond which a closure contradicts all the others."""


class Closures(NamedTuple):
    """poses : (n, 3) of the key scans, smoothed.  chain : tracking's edges, less those of relocated key scans.

    closures : edges between places that were matched again, and hold.  refused : those that the others contradict, or
    that nothing supported.
    """

    poses: Array
    chain: Edges
    closures: Edges
    refused: Edges


def close_loops(tracking: Tracking, range_sigma: float, track: Track) -> Closures:
    """Find loops, smooth, and look again from the better poses, until nothing new turns up."""
    poses = tracking.poses[tracking.keys]
    noise = match_noise(range_sigma)
    way = _search(tracking, poses, noise).way
    chain, closures, failed = tracking.edges, _relinks(tracking, noise), dict[tuple[int, int], Array]()
    alone = [no_edges()]
    if len(closures.first):
        poses = posegraph.optimise(poses, joined([chain, closures])).poses
    poses, chain, again = recognised(_search(tracking, poses, noise), lost_runs(tracking), chain, closures)
    closures = joined([closures, again])
    if len(again.first):
        poses = posegraph.optimise(poses, joined([chain, closures])).poses
    wide = False
    for k in range(ROUNDS):
        track("slam: loops", k, ROUNDS)
        look = _search(tracking, poses, noise)._replace(way=way)
        # A first look at few places sets the poses right for the others: fewer candidates lead nowhere.
        spacing = WIDE_SPACING if wide or k == 0 else SPACING
        found = _find(look, closures, failed, spacing, joined([chain, closures]) if wide else None)
        if wide:
            found = joined([found, witnesses(look, take(found, ~_supported(look, found)))])
        supported = _supported(look, found)
        alone.append(take(found, ~supported))
        found = take(found, supported)
        if len(found.first) == 0:
            if k == 0:
                continue
            if wide:
                break
            # Where the poses lead past no known place, they may be too far off for a match without a search.
            wide = True
            continue
        wide = False
        closures = joined([closures, found])
        poses = posegraph.optimise(poses, joined([chain, closures])).poses
    holds = _holding(poses, closures)
    closures, refused = take(closures, holds), take(closures, ~holds)
    poses = posegraph.optimise(poses, joined([chain, closures])).poses
    relocated = _relocated(tracking, poses, noise)
    if len(relocated.first):
        chain = take(chain, ~(np.isin(chain.second, relocated.second) & tracking.weak[chain.second]))
        closures = joined([closures, relocated])
        poses = posegraph.optimise(poses, joined([chain, closures])).poses
    track("slam: loops", ROUNDS, ROUNDS)
    return Closures(poses, chain, closures, joined([refused, _never_made(alone, closures, refused)]))


def _search(tracking: Tracking, poses: Array, noise: float) -> Search:
    """The key scans at poses (n, 3)."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    return Search(tracking.points, poses, way, noise, tracking.keys, tracking.views)


def _never_made(alone: list[Edges], *made: Edges) -> Edges:
    """The last one of each pair of key scans that no edge of `made` joins."""
    found = joined(alone)
    joins = {pair for edges in made for pair in zip(edges.first.tolist(), edges.second.tolist(), strict=True)}
    pairs = zip(found.first.tolist(), found.second.tolist(), strict=True)
    last = {pair: k for k, pair in enumerate(pairs) if pair not in joins}
    return take(found, np.array(sorted(last.values()), int))


def _holding(poses: Array, closures: Edges) -> NDArray[np.bool_]:
    """(m,) closures that the smoothed trajectory does not contradict."""
    distance, _ = posegraph.weighted(closures, posegraph.residuals(poses, closures)[0])
    return distance < WRONG


def failed_runs(weak: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First key scan of each run of two or more failed ones, and the first after it, where there is one before."""
    border = np.flatnonzero(np.diff(np.concatenate([[0], weak, [0]]).astype(int))).reshape(-1, 2)
    return [(a, b) for a, b in border.tolist() if b - a >= 2 and a > 0 and b < len(weak)]


def lost_runs(tracking: Tracking) -> list[tuple[int, int]]:
    """Of the runs of failed key scans those that begin where nothing tells how the robot got there."""
    return [(a, b) for a, b in failed_runs(tracking.weak) if tracking.adrift[a]]


def _relinks(tracking: Tracking, noise: float) -> Edges:
    """An edge across each run of failed key scans: the small maps on both sides of it, matched."""
    poses = tracking.poses[tracking.keys]
    look = _search(tracking, poses, noise)
    parts = [no_edges()]
    for start, after in failed_runs(tracking.weak):
        before = start - 1
        source = source_map(look, after, range(after, min(after + SOURCE_KEYS, len(poses))))
        target = target_map(look, before, range(max(before - TARGET_KEYS, 0), before + 1))
        found = register(source, target, se2.between(poses[before], poses[after]), noise, 1.5, 0.8)
        if found is not None:
            parts.append(closure_edge(before, after, found))
    return joined(parts)


def _relocated(tracking: Tracking, poses: Array, noise: float) -> Edges:
    """Edges of failed key scans to the one before, from a match to the smoothed map of those before and after.

    What tracking could not place, for most of what it saw was new or the odometry was wrong, has its place now.
    """
    look = _search(tracking, poses, noise)
    sound = np.flatnonzero(~tracking.weak)
    found = [no_edges()]
    for key in np.flatnonzero(tracking.weak).tolist():
        at = int(np.searchsorted(sound, key))
        near = sound[max(at - TARGET_KEYS, 0) : at + TARGET_KEYS]
        before, after = int(sound[max(at - 1, 0)]), int(sound[min(at, len(sound) - 1)])
        target = make_target(small_map(look, before, near.tolist()))
        guesses = [se2.between(poses[before], poses[k]) for k in (key, after, before)]
        matches = [register(tracking.points[key], target, guess, noise, 1.5, 0.8) for guess in guesses]
        best = max((m for m in matches if m is not None), key=lambda m: m.inliers, default=None)
        if best is not None:
            found.append(closure_edge(before, key, best))
    return joined(found)


def _find(
    look: Search,
    closures: Edges,
    failed: dict[tuple[int, int], Array],
    spacing: float,
    graph: Edges | None = None,
) -> Edges:
    """Closures between places that are near each other by the poses as they are, every `spacing` metres of way.

    closures : found before; the same visit is not closed twice.  failed : guesses from which a match failed; they are
    not tried again, and new ones are added.
    graph : all edges; with them a wider search is made, for places that they leave far apart.
    """
    found, targets = [no_edges()], dict[int, Target]()
    known = set(zip(closures.second.tolist(), (closures.first // TARGET_KEYS).tolist(), strict=True))
    candidates = near_candidates(look, spacing) if graph is None else far_candidates(look, spacing, graph)
    for here, before, span in candidates:
        visit = before // TARGET_KEYS
        if known & {(here, visit - 1), (here, visit), (here, visit + 1)}:
            continue
        guess = se2.between(look.poses[before], look.poses[here])
        if graph is None and (before, here) in failed and _alike(guess, failed[before, here]):
            continue
        if before not in targets:
            if len(targets) == KEPT:
                targets.clear()
            targets[before] = target_map(look, before)
        closure = revisit(look, targets[before], before, here, guess, span, 0.0 if graph is None else WIDE_TURN)
        if closure is None:
            failed[before, here] = guess
        else:
            found.append(closure_edge(before, here, closure))
    return joined(found)


def _alike(a: Array, b: Array) -> bool:
    """Whether two guesses lead a match to the same place."""
    return bool(np.hypot(a[0] - b[0], a[1] - b[1]) < 0.2 and abs(se2.wrap(a[2] - b[2])) < 0.05)


def _supported(look: Search, found: Edges) -> NDArray[np.bool_]:
    """(m,) closures that move little, or that another one, from a place near by, agrees with.

    One place that looks like another is a matter of chance; several in a row that are moved alike are not.
    """
    bold = ~agree(found.relative, se2.between(look.poses[found.first], look.poses[found.second]))
    moved = se2.compose(look.poses[found.first], found.relative)  # where the closure puts its second key scan
    out = ~bold
    for k in np.flatnonzero(bold):
        way = np.abs(look.way[found.second] - look.way[found.second[k]])
        near = np.flatnonzero((way > 0) & (way < SUPPORT_WAY))
        # Where this closure would put the other one's key scan, by the trajectory between the two.
        there = se2.compose(moved[k], se2.between(look.poses[found.second[k]], look.poses[found.second[near]]))
        out[k] = bool(np.any(agree(there, moved[near])))
    return out
