"""Small maps of key scans, and edges between places by matching them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined, take
from bsmap_cli.model import Array, IntArray
from bsmap_cli.slam.matching import (
    LEAST_REACH,
    SAME_WAY,
    Match,
    OrientedPoints,
    Target,
    make_target,
    match,
    nearest_points,
    search,
)
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.visibility import View, Views, Visit, contradicting

AGREEMENT, LEAST_AGREEMENT, CONTRADICTION = 0.7, 0.5, 0.07
"""Shares of points that must lie on the other map; the lesser one where beams are asked too, which then may pass
through no more than the last share of the points."""
SOURCE_KEYS, TARGET_KEYS = 5, 10
"""Key scans before and after that make the small maps."""
SOURCE_POINTS, TARGET_POINTS = 150, 600
CLOSURE_FLOOR = (0.02, 0.02, 0.005)
"""Standard deviations of a closure beside that of the match: metres, metres, radians."""
WIDTH, CHANCE = 0.05, 2.0
"""Metres by which a pair of points may be apart at half its weight; standard deviations that chance may add up to."""
BOLD = (0.5, 0.1)
"""Metres and radians by which poses may differ and still agree."""


class Search(NamedTuple):
    """What the search for loops looks at.

    points : of each key scan, in base_link.  poses : (n, 3).  way : (n,) metres driven to each.  noise : metres, of a
    point's distance to the map.  keys : (n,) numbers of the scans.  views : of the laser.
    """

    points: list[OrientedPoints]
    poses: Array
    way: Array
    noise: float
    keys: IntArray
    views: Views


def no_edges() -> Edges:
    """A table of edges without any."""
    none = np.zeros(0, int)
    return Edges(none, none, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0, bool))


def agree(a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether poses (..., 3) differ by no more than closures that move the trajectory alike."""
    apart = se2.between(a, b)
    return np.asarray((np.hypot(apart[..., 0], apart[..., 1]) < BOLD[0]) & (np.abs(apart[..., 2]) < BOLD[1]))


def around(centre: int, half: int, count: int) -> range:
    """Up to `half` key scans to either side of one, of `count` in all."""
    return range(max(centre - half, 0), min(centre + half + 1, count))


def source_map(look: Search, centre: int, keys: range | None = None) -> OrientedPoints:
    """Points of key scans (by default those near it) in the frame of one, evenly thinned to about SOURCE_POINTS."""
    keys = around(centre, SOURCE_KEYS, len(look.poses)) if keys is None else keys
    count = sum(len(look.points[j].xy) for j in keys)
    return small_map(look, centre, keys, max(1, count // SOURCE_POINTS))


def target_map(look: Search, centre: int, keys: range | None = None) -> Target:
    """Points of key scans (by default those near it) in the frame of one, to be matched against."""
    return make_target(small_map(look, centre, around(centre, TARGET_KEYS, len(look.poses)) if keys is None else keys))


def small_map(look: Search, centre: int, keys: Sequence[int], step: int = 1) -> OrientedPoints:
    """Every `step`-th point of key scans in the frame of one of them."""
    points = take(joined([look.points[j] for j in keys]), slice(None, None, step))
    owner = np.repeat(np.arange(len(keys)), [len(look.points[j].xy) for j in keys])[::step]
    return points.moved_each(se2.between(look.poses[centre], look.poses[list(keys)]), owner)


def register(
    source: OrientedPoints,
    target: Target,
    guess: Array,
    noise: float,
    span: float,
    turn: float,
    least: float = AGREEMENT,
) -> Match | None:
    """Match of two small maps, from the guess, with what it knows surely; None where they do not agree.

    span, turn : metres and radians about the guess that are searched where the match from there fails; no turn: none.
    least : share of the source's points that must lie on the target.
    """
    loose = np.diag([0.01, 0.01, 0.25])
    found = match(source, target, guess, loose, noise, reach=1.0)
    if found.inliers < least and turn == 0.0:
        return None
    starts = [] if found.inliers >= AGREEMENT or turn == 0.0 else search(source, target, guess, span, turn)
    for start in starts:
        coarse = match(source, target, start, loose, noise, max(0.5, span / 6))
        if coarse.inliers > found.inliers:
            found = coarse
    if found.inliers < least:
        return None
    return found._replace(information=sure_information(source, target, found.pose, noise))


def revisit(
    look: Search, target: Target, first: int, second: int, guess: Array, span: float, turn: float
) -> Match | None:
    """Match of what was seen about the second key scan to the `target`, what was seen about the first one.

    Where it moves the trajectory far, or few points match, beams must bear it out: one corridor looks like another,
    but what stands in its doorways does not, and beams of the one pass through it in the other.
    """
    source = source_map(look, second)
    least = AGREEMENT if turn else LEAST_AGREEMENT  # the wider the search, the more looks alike by chance
    found = register(source, target, guess, look.noise, span, turn, least)
    stays = found is not None and agree(found.pose, se2.between(look.poses[first], look.poses[second]))
    if found is None or (found.inliers >= AGREEMENT and stays):
        return found
    before = Visit(thinned(target.points), _views(look, np.zeros(3), first, TARGET_KEYS))
    now = Visit(source.moved(found.pose), _views(look, found.pose, second, SOURCE_KEYS))
    return found if contradicting(before, now, look.views, look.noise) <= CONTRADICTION else None


def thinned(points: OrientedPoints) -> OrientedPoints:
    """About TARGET_POINTS of the points."""
    return take(points, slice(None, None, max(1, len(points.xy) // TARGET_POINTS)))


def _views(look: Search, pose: Array, centre: int, half: int) -> list[View]:
    """Views of the key scans about one, in the frame in which that one's `pose` (3,) is given."""
    keys = list(around(centre, half, len(look.poses)))
    placed = se2.compose(pose, se2.between(look.poses[centre], look.poses[keys]))
    return [look.views.view(int(look.keys[j]), p) for j, p in zip(keys, placed, strict=True)]


def sure_information(source: OrientedPoints, target: Target, pose: Array, noise: float) -> Array:
    """(3, 3) information of a match at `pose` (3,), in the target's frame, less what noise of the normals feigns.

    The normals of a smooth wall scatter, and the squares of what each has along the wall add up to what looks like
    knowledge of the place there. Products of the two normals of a pair have the right mean, for their noise is
    independent; and of a sum of such, what is below twice its standard deviation may be chance.
    """
    moved = source.moved(pose)
    distance, nearest = nearest_points(target, moved.xy, LEAST_REACH)
    near = np.flatnonzero(np.isfinite(distance))
    there, here = take(target.points, nearest[near]), take(moved, near)
    facing = np.flatnonzero(np.einsum("ij,ij->i", there.normal, here.normal) > SAME_WAY)
    there, here = take(there, facing), take(here, facing)
    arm = here.xy - pose[:2]
    error = np.einsum("ij,ij->i", there.normal, here.xy - there.xy) / max(2 * noise, WIDTH)
    weight = 1.0 / (noise**2 * (1.0 + error**2))
    lever = max(float(np.sqrt((arm**2).sum() / max(len(arm), 1))), 1e-3)
    scale = np.array([1.0, 1.0, 1.0 / lever])
    by_there, by_here = (
        np.column_stack([n, n[:, 1] * arm[:, 0] - n[:, 0] * arm[:, 1]]) * scale for n in (there.normal, here.normal)
    )
    both = (by_there * weight[:, None]).T @ by_here
    axes = np.linalg.eigh((both + both.T) / 2)[1]
    parts = weight[:, None] * (by_there @ axes) * (by_here @ axes)
    known = np.maximum(parts.sum(axis=0) - CHANCE * np.sqrt((parts**2).sum(axis=0)), 0.0)
    axes = axes / scale[:, None]
    return np.asarray((axes * known) @ axes.T, dtype=np.float64)


def closure_edge(first: int, second: int, found: Match) -> Edges:
    """Edge of a match, with what a match can be off by although it looks good."""
    covariance = np.linalg.inv(found.information / 4 + 1e-3 * np.eye(3)) + np.diag(CLOSURE_FLOOR) ** 2
    information = np.linalg.inv(covariance)
    return Edges(np.array([first]), np.array([second]), found.pose[None], information[None], np.array([True]))
