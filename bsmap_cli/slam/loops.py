"""Loop closing: places seen before, recognised by matching small maps of key scans, verified, smoothed over."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined, take
from bsmap_cli.model import Array
from bsmap_cli.slam import posegraph
from bsmap_cli.slam.matching import Match, OrientedPoints, Target, make_target, match, search
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.tracking import Tracking, match_noise
from bsmap_cli.track import Track

ROUNDS = 8
SPACING = 1.0
"""Metres of way between key scans for which loops are sought."""
WIDE_SPACING, WIDE_TURN, UNHELD = 3.0, 0.5, 10.0
"""Metres of way between wide searches, radians to both sides, metres of way from any closure where they are made."""
LEAST_WAY = 8.0
"""Metres of way that make a return to a place a loop."""
REACH, DRIFT, MOST_REACH = 2.0, 0.02, 10.0
"""A place counts as near within REACH metres, and DRIFT more for each metre of way since, up to MOST_REACH."""
PASSES = 3
"""Earlier visits to a place that are tried, nearest first."""
AGREEMENT = 0.7
"""Share of points that must lie on the other map."""
SOURCE_KEYS, TARGET_KEYS = 5, 10
"""Key scans before and after that make the small maps."""
SOURCE_POINTS = 150
KEPT = 64
"""Small maps that are kept for the next candidates, for neighbours ask for the same ones."""
CLOSURE_FLOOR = (0.02, 0.02, 0.005)
"""Standard deviations of a closure beside that of the match: metres, metres, radians."""
BOLD, SUPPORT_WAY = (0.5, 0.1), 10.0
"""A closure that moves the trajectory by more metres or radians needs another one, so many metres of way off."""
WITNESS_WAYS, FEWEST_WITNESSES = np.array([-9.0, -6.0, -3.0, 3.0, 6.0, 9.0]), 2
"""Metres of way from a closure that nothing supports at which others are sought, and how many must be found."""
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


class _Search(NamedTuple):
    """What the search for loops looks at: key scans, their poses and the way to each of them."""

    points: list[OrientedPoints]
    poses: Array
    way: Array
    noise: float


def close_loops(tracking: Tracking, range_sigma: float, track: Track) -> Closures:
    """Find loops, smooth, and look again from the better poses, until nothing new turns up."""
    poses = tracking.poses[tracking.keys]
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    noise = match_noise(range_sigma)
    chain, closures, failed = tracking.edges, _relinks(tracking, noise), dict[tuple[int, int], Array]()
    alone = [_no_edges()]
    if len(closures.first):
        poses = posegraph.optimise(poses, joined([chain, closures])).poses
    wide = False
    for k in range(ROUNDS):
        track("slam: loops", k, ROUNDS)
        look = _Search(tracking.points, poses, way, noise)
        found = _find(look, closures, failed, _far_from(closures, way) if wide else None)
        if wide:
            found = joined([found, _witnesses(look, take(found, ~_supported(look, found)))])
        supported = _supported(look, found)
        alone.append(take(found, ~supported))
        found = take(found, supported)
        if len(found.first) == 0:
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


def _never_made(alone: list[Edges], *made: Edges) -> Edges:
    """The last one of each pair of key scans that no edge of `made` joins."""
    found = joined(alone)
    joins = {pair for edges in made for pair in zip(edges.first.tolist(), edges.second.tolist(), strict=True)}
    pairs = zip(found.first.tolist(), found.second.tolist(), strict=True)
    last = {pair: k for k, pair in enumerate(pairs) if pair not in joins}
    return take(found, np.array(sorted(last.values()), int))


def is_loop(poses: Array, edges: Edges) -> NDArray[np.bool_]:
    """(m,) edges with so much way along the poses (n, 3) between their ends that they close a loop.

    The others lead past scans that could not be matched.
    """
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    return np.asarray(way[edges.second] - way[edges.first] > LEAST_WAY)


def _no_edges() -> Edges:
    none = np.zeros(0, int)
    return Edges(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, bool))


def _holding(poses: Array, closures: Edges) -> NDArray[np.bool_]:
    """(m,) closures that the smoothed trajectory does not contradict."""
    distance, _ = posegraph.weighted(closures, posegraph.residuals(poses, closures)[0])
    return distance < WRONG


def _relinks(tracking: Tracking, noise: float) -> Edges:
    """An edge across each run of failed key scans: the small maps on both sides of it, matched."""
    poses = tracking.poses[tracking.keys]
    look = _Search(tracking.points, poses, np.zeros(len(poses)), noise)
    parts = [_no_edges()]
    border = np.flatnonzero(np.diff(np.concatenate([[0], tracking.weak, [0]]).astype(int)))
    for start, after in border.reshape(-1, 2).tolist():
        before = start - 1
        if after - start < 2 or after >= len(poses):
            continue
        source = _source(look, after, range(after, min(after + SOURCE_KEYS, len(poses))))
        target = _target(look, before, range(max(before - TARGET_KEYS, 0), before + 1))
        found = _register(source, target, se2.between(poses[before], poses[after]), noise, 1.5, 0.8)
        if found is not None:
            parts.append(_closure(before, after, found))
    return joined(parts)


def _far_from(closures: Edges, way: Array) -> NDArray[np.bool_]:
    """(n,) key scans that are a long way from any that a closure holds."""
    held = np.sort(way[np.concatenate([closures.first, closures.second])])
    if len(held) == 0:
        return np.ones(len(way), bool)
    next_one = np.searchsorted(held, way).clip(1, len(held) - 1) if len(held) > 1 else np.zeros(len(way), int)
    return np.minimum(np.abs(way - held[next_one]), np.abs(way - held[next_one - 1])) > UNHELD


def _relocated(tracking: Tracking, poses: Array, noise: float) -> Edges:
    """Edges of failed key scans to the one before, from a match to the smoothed map of those before and after.

    What tracking could not place, for most of what it saw was new or the odometry was wrong, has its place now.
    """
    look = _Search(tracking.points, poses, np.zeros(len(poses)), noise)
    sound = np.flatnonzero(~tracking.weak)
    found = [_no_edges()]
    for key in np.flatnonzero(tracking.weak).tolist():
        at = int(np.searchsorted(sound, key))
        around = sound[max(at - TARGET_KEYS, 0) : at + TARGET_KEYS]
        before, after = int(sound[max(at - 1, 0)]), int(sound[min(at, len(sound) - 1)])
        target = make_target(_small_map(look, before, around.tolist()))
        guesses = [se2.between(poses[before], poses[k]) for k in (key, after, before)]
        matches = [_register(tracking.points[key], target, guess, noise, 1.5, 0.8) for guess in guesses]
        best = max((m for m in matches if m is not None), key=lambda m: m.inliers, default=None)
        if best is not None:
            found.append(_closure(before, key, best))
    return joined(found)


def _find(
    look: _Search, closures: Edges, failed: dict[tuple[int, int], Array], wide: NDArray[np.bool_] | None = None
) -> Edges:
    """Closures between places that are near each other by the poses as they are.

    closures : found before; the same visit is not closed twice.  failed : guesses from which a match failed; they are
    not tried again, and new ones are added.
    wide : (n,) key scans for which, and only for them, a wider search is made where the match from there fails.
    """
    found, targets = [_no_edges()], dict[int, Target]()
    known = set(zip(closures.second.tolist(), (closures.first // TARGET_KEYS).tolist(), strict=True))
    for here, before in _candidates(look, SPACING if wide is None else WIDE_SPACING):
        visit = before // TARGET_KEYS
        if known & {(here, visit - 1), (here, visit), (here, visit + 1)} or (wide is not None and not wide[here]):
            continue
        guess = se2.between(look.poses[before], look.poses[here])
        if wide is None and (before, here) in failed and _alike(guess, failed[before, here]):
            continue
        if before not in targets:
            if len(targets) == KEPT:
                targets.clear()
            targets[before] = _target(look, before, _around(before, TARGET_KEYS, len(look.poses)))
        source = _source(look, here, _around(here, SOURCE_KEYS, len(look.poses)))
        span = float(_reach(look.way[here] - look.way[before]))
        closure = _register(source, targets[before], guess, look.noise, span, 0.0 if wide is None else WIDE_TURN)
        if closure is None:
            failed[before, here] = guess
        else:
            found.append(_closure(before, here, closure))
    return joined(found)


def _alike(a: Array, b: Array) -> bool:
    """Whether two guesses lead a match to the same place."""
    return bool(np.hypot(a[0] - b[0], a[1] - b[1]) < 0.2 and abs(se2.wrap(a[2] - b[2])) < 0.05)


def _supported(look: _Search, found: Edges) -> NDArray[np.bool_]:
    """(m,) closures that move little, or that another one, from a place near by, agrees with.

    One place that looks like another is a matter of chance; several in a row that are moved alike are not.
    """
    bold = ~_agree(found.relative, se2.between(look.poses[found.first], look.poses[found.second]))
    moved = se2.compose(look.poses[found.first], found.relative)  # where the closure puts its second key scan
    out = ~bold
    for k in np.flatnonzero(bold):
        way = np.abs(look.way[found.second] - look.way[found.second[k]])
        near = np.flatnonzero((way > 0) & (way < SUPPORT_WAY))
        # Where this closure would put the other one's key scan, by the trajectory between the two.
        there = se2.compose(moved[k], se2.between(look.poses[found.second[k]], look.poses[found.second[near]]))
        out[k] = bool(np.any(_agree(there, moved[near])))
    return out


def _witnesses(look: _Search, alone: Edges) -> Edges:
    """Closures that bear out those that nothing supports, looked for where these would put the places near by.

    After a long way to a known place the poses may be off so far that hardly any candidate leads to a match. One that
    did tells where its neighbours are; what FEWEST_WITNESSES of them find there is no chance.
    """
    found = [_no_edges()]
    for first, second, relative in zip(alone.first.tolist(), alone.second.tolist(), alone.relative, strict=True):
        there = se2.compose(se2.compose(look.poses[first], relative), se2.between(look.poses[second], look.poses))
        others = np.unique(np.searchsorted(look.way, look.way[second] + WITNESS_WAYS).clip(max=len(look.way) - 1))
        seen = [_witness(look, other, there[other]) for other in others.tolist() if other != second]
        agreeing = [closure for closure in seen if closure is not None]
        if len(agreeing) >= FEWEST_WITNESSES:
            found += agreeing
    return joined(found)


def _witness(look: _Search, here: int, pose: Array) -> Edges | None:
    """The closure of a key scan, were it at `pose` (3,), with the nearest one of long before."""
    distance = np.hypot(*(look.poses[: here + 1, :2] - pose[:2]).T)
    distance[look.way[here] - look.way[: here + 1] <= LEAST_WAY] = np.inf
    before = int(np.argmin(distance))
    if distance[before] > REACH:
        return None
    target = _target(look, before, _around(before, TARGET_KEYS, len(look.poses)))
    source = _source(look, here, _around(here, SOURCE_KEYS, len(look.poses)))
    guess = se2.between(look.poses[before], pose)
    seen = _register(source, target, guess, look.noise, 0.0, 0.0)
    return _closure(before, here, seen) if seen is not None and _agree(guess, seen.pose) else None


def _agree(a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether poses (..., 3) differ by no more than closures that move the trajectory alike."""
    apart = se2.between(a, b)
    return np.asarray((np.hypot(apart[..., 0], apart[..., 1]) < BOLD[0]) & (np.abs(apart[..., 2]) < BOLD[1]))


def _reach(way: Array) -> Array:
    return np.minimum(REACH + DRIFT * way, MOST_REACH)


def _candidates(look: _Search, spacing: float) -> Iterator[tuple[int, int]]:
    """Pairs (here, before): every `spacing` metres of way, the nearest key scan of the nearest earlier visits."""
    next_way = 0.0
    for here in range(len(look.poses)):
        if look.way[here] < next_way:
            continue
        next_way = look.way[here] + spacing
        since = look.way[here] - look.way[:here]
        distance = np.hypot(*(look.poses[:here, :2] - look.poses[here, :2]).T)
        near = np.flatnonzero((since > LEAST_WAY) & (distance < _reach(since)))
        if len(near) == 0:
            continue
        visits = np.split(near, np.flatnonzero(np.diff(look.way[near]) > 2 * REACH) + 1)
        nearest = sorted((visit[np.argmin(distance[visit])] for visit in visits), key=lambda j: distance[j])
        for before in nearest[:PASSES]:
            yield here, int(before)


def _around(centre: int, half: int, count: int) -> range:
    return range(max(centre - half, 0), min(centre + half + 1, count))


def _source(look: _Search, centre: int, keys: range) -> OrientedPoints:
    """Points of key scans in the frame of one of them, evenly thinned to about SOURCE_POINTS."""
    count = sum(len(look.points[j].xy) for j in keys)
    return _small_map(look, centre, keys, max(1, count // SOURCE_POINTS))


def _target(look: _Search, centre: int, keys: range) -> Target:
    return make_target(_small_map(look, centre, keys))


def _small_map(look: _Search, centre: int, keys: Sequence[int], step: int = 1) -> OrientedPoints:
    """Every `step`-th point of key scans in the frame of one of them."""
    points = take(joined([look.points[j] for j in keys]), slice(None, None, step))
    owner = np.repeat(np.arange(len(keys)), [len(look.points[j].xy) for j in keys])[::step]
    return points.moved(se2.between(look.poses[centre], look.poses[list(keys)])[owner])


def _register(
    source: OrientedPoints, target: Target, guess: Array, noise: float, span: float, turn: float
) -> Match | None:
    """Match of two small maps, from the guess; None where they do not agree."""
    loose = np.diag([0.01, 0.01, 0.25])
    found = match(source, target, guess, loose, noise, reach=1.0)
    if found.inliers >= AGREEMENT:
        return found
    if turn == 0.0:
        return None
    for start in search(source, target, guess, span, turn):
        coarse = match(source, target, start, loose, noise, max(0.5, span / 6))
        if coarse.inliers > found.inliers:
            found = coarse
    return found if found.inliers >= AGREEMENT else None


def _closure(first: int, second: int, found: Match) -> Edges:
    """Edge of a match, with what a match can be off by although it looks good."""
    covariance = np.linalg.inv(found.information / 4 + 1e-3 * np.eye(3)) + np.diag(CLOSURE_FLOOR) ** 2
    information = np.linalg.inv(covariance)
    return Edges(np.array([first]), np.array([second]), found.pose[None], information[None], np.array([True]))
