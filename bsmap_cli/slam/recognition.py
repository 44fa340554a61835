"""Places that are told by others near by, or, where the track was lost, by what they look like."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined
from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.matching import OrientedPoints
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.submaps import (
    BOLD,
    SOURCE_KEYS,
    TARGET_KEYS,
    Search,
    agree,
    closure_edge,
    no_edges,
    revisit,
    source_map,
    target_map,
)

LEAST_WAY = 8.0
"""Metres of way that make a return to a place a loop."""
REACH = 2.0
"""Metres within which a place is near, however short the way since."""
WITNESS_WAYS, FEWEST_WITNESSES = np.array([-9.0, -6.0, -3.0, 3.0, 6.0, 9.0]), 2
"""Metres of way from a closure that nothing supports at which others are sought, and how many must be found."""
TRIES, PLACE_SPACING, ALIKE = 6, 2.0, 5
"""Places after a break that are looked for, metres of way between them and between those they are compared with, and
how many of these, the most alike, are matched."""
PLACE_SPAN, TURN_STEP, TURNS = 1.2, 2 * np.pi / 48, 6
"""Metres about a place within which the other is sought; radians between turns, and how many of these are tried."""
FINGER_POINTS, FINGER_REACH, DISTANCES, ANGLES = 120, 8.0, 16, 4
"""Points of a fingerprint, metres between two of them at the most, and its bins."""


def witnesses(look: Search, alone: Edges) -> Edges:
    """Closures that bear out those that nothing supports, looked for where these would put the places near by.

    After a long way to a known place the poses may be off so far that hardly any candidate leads to a match. One that
    did tells where its neighbours are; what FEWEST_WITNESSES of them find there is no chance.
    """
    found = [no_edges()]
    for first, second, relative in zip(alone.first.tolist(), alone.second.tolist(), alone.relative, strict=True):
        there = se2.compose(se2.compose(look.poses[first], relative), se2.between(look.poses[second], look.poses))
        others = np.unique(np.searchsorted(look.way, look.way[second] + WITNESS_WAYS).clip(max=len(look.way) - 1))
        seen = [_witness(look, other, there[other]) for other in others.tolist() if other != second]
        agreeing = [closure for closure in seen if closure is not None]
        if len(agreeing) >= FEWEST_WITNESSES:
            found += agreeing
    return joined(found)


def _witness(look: Search, here: int, pose: Array) -> Edges | None:
    """The closure of a key scan, were it at `pose` (3,), with the nearest one of long before."""
    distance = np.hypot(*(look.poses[: here + 1, :2] - pose[:2]).T)
    distance[look.way[here] - look.way[: here + 1] <= LEAST_WAY] = np.inf
    before = int(np.argmin(distance))
    if distance[before] > REACH:
        return None
    guess = se2.between(look.poses[before], pose)
    seen = revisit(look, target_map(look, before), before, here, guess, *BOLD)
    return closure_edge(before, here, seen) if seen is not None and agree(guess, seen.pose) else None


class Recognised(NamedTuple):
    """poses : (n, 3).  chain : its edges, those across a break as the place that was recognised tells.

    closures : edges from what came after breaks to places before them.
    """

    poses: Array
    chain: Edges
    closures: Edges


def recognised(look: Search, breaks: list[tuple[int, int]], chain: Edges, closures: Edges) -> Recognised:
    """What comes after a break, put where it looks like what was seen before.

    A break is a run of key scans whose match failed and that nothing links: the robot was carried, or its odometry
    began anew. Then the poses do not tell where it is.

    breaks : first key scan of each and the first after it.  closures : edges known, across breaks too.
    """
    poses, found = look.poses, [no_edges()]
    for start, after in breaks:
        if np.any((closures.first < start) & (closures.second >= after)):
            continue
        look = look._replace(poses=poses)
        again = _recognise(look, start, after)
        if len(again.first) == 0:
            continue
        first, second = int(again.first[0]), int(again.second[0])
        poses = poses.copy()
        there = se2.compose(poses[first], again.relative[0])
        poses[start:] = se2.compose(there, se2.between(poses[second], poses[start:]))
        across = np.flatnonzero((chain.first < start) & (chain.second >= start))
        relative = chain.relative.copy()
        relative[across] = se2.between(poses[chain.first[across]], poses[chain.second[across]])
        chain = chain._replace(relative=relative)
        found.append(again)
    return Recognised(poses, chain, joined(found))


def _recognise(look: Search, start: int, after: int) -> Edges:
    """The closure of a key scan after a break with one before it, and its witnesses; none where nothing is sure."""
    there = np.arange(TARGET_KEYS, start - TARGET_KEYS)
    places = _spaced(look.way, there)
    here = _spaced(look.way, np.arange(after + SOURCE_KEYS, len(look.way)))[:TRIES]
    if len(places) == 0:
        return no_edges()
    maps = [target_map(look, int(k)) for k in places]
    prints = np.array([fingerprint(target.points) for target in maps])
    for key in here.tolist():
        source = source_map(look, key)
        apart = np.abs(prints - fingerprint(source)).sum(axis=1)
        for k in np.argsort(apart, kind="stable")[:ALIKE].tolist():
            turns = likely_turns(source.normal, maps[k].points.normal)
            guesses = [np.array([0.0, 0.0, turn]) for turn in turns]
            place = int(places[k])
            matches = [revisit(look, maps[k], place, key, guess, PLACE_SPAN, TURN_STEP) for guess in guesses]
            best = max((m for m in matches if m is not None), key=lambda m: m.inliers, default=None)
            if best is None:
                continue
            closure = closure_edge(place, key, best)
            others = witnesses(look, closure)
            if len(others.first):
                return joined([closure, others])
    return no_edges()


def likely_turns(source: Array, target: Array) -> list[float]:
    """Radians by which unit normals (n, 2) turn to be spread like others (m, 2): the best of all, and the next."""
    bins = round(2 * np.pi / TURN_STEP)
    spread = []
    for x, y in (source.T, target.T):
        direction = np.floor(np.arctan2(y, x) / TURN_STEP).astype(int) % bins
        spread.append(np.bincount(direction, minlength=bins))
    alike = np.fft.irfft(np.fft.rfft(spread[1]) * np.conj(np.fft.rfft(spread[0])), bins)
    peak = (alike >= np.roll(alike, 1)) & (alike > np.roll(alike, -1))
    best = sorted(np.flatnonzero(peak).tolist(), key=lambda k: -alike[k])[:TURNS]
    return [TURN_STEP * k for k in best]


def _spaced(way: Array, keys: IntArray) -> IntArray:
    """Of key scans in order, the first in each stretch of way."""
    stretch = np.floor(way[keys] / PLACE_SPACING)
    return keys[np.diff(stretch, prepend=-1.0) > 0]


def fingerprint(points: OrientedPoints) -> Array:
    """(DISTANCES * ANGLES,) shares of pairs of points by their distance and by the angle between their normals.

    The same from wherever a place is looked at, and however the robot is turned (as the shape distributions of Osada
    et al. 2002).
    """
    thin = slice(None, None, max(1, len(points.xy) // FINGER_POINTS))
    xy, normal = points.xy[thin], points.normal[thin]
    one, other = np.triu_indices(len(xy), 1)
    distance = np.hypot(*(xy[one] - xy[other]).T)
    cosine = np.einsum("ij,ij->i", normal[one], normal[other])
    near = distance < FINGER_REACH
    row = np.minimum((distance[near] / FINGER_REACH * DISTANCES).astype(int), DISTANCES - 1)
    column = np.minimum(((1.0 + cosine[near]) / 2.0 * ANGLES).astype(int).clip(0), ANGLES - 1)
    count = np.bincount(row * ANGLES + column, minlength=DISTANCES * ANGLES)
    return count / max(count.sum(), 1)
