"""Small maps of key scans, and edges between places by matching them."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core import se2
from bsmap_cli.core.table import joined, take
from bsmap_cli.model import Array
from bsmap_cli.slam.matching import Match, OrientedPoints, Target, make_target, match, search
from bsmap_cli.slam.posegraph import Edges

AGREEMENT = 0.7
"""Share of points that must lie on the other map."""
SOURCE_KEYS, TARGET_KEYS = 5, 10
"""Key scans before and after that make the small maps."""
SOURCE_POINTS = 150
CLOSURE_FLOOR = (0.02, 0.02, 0.005)
"""Standard deviations of a closure beside that of the match: metres, metres, radians."""
BOLD = (0.5, 0.1)
"""Metres and radians by which poses may differ and still agree."""


class Search(NamedTuple):
    """What the search for loops looks at.

    points : of each key scan, in base_link.  poses : (n, 3).  way : (n,) metres driven to each.  noise : metres, of a
    point's distance to the map.
    """

    points: list[OrientedPoints]
    poses: Array
    way: Array
    noise: float


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
    source: OrientedPoints, target: Target, guess: Array, noise: float, span: float, turn: float
) -> Match | None:
    """Match of two small maps, from the guess; None where they do not agree.

    span, turn : metres and radians about the guess that are searched where the match from there fails; no turn: none.
    """
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


def closure_edge(first: int, second: int, found: Match) -> Edges:
    """Edge of a match, with what a match can be off by although it looks good."""
    covariance = np.linalg.inv(found.information / 4 + 1e-3 * np.eye(3)) + np.diag(CLOSURE_FLOOR) ** 2
    information = np.linalg.inv(covariance)
    return Edges(np.array([first]), np.array([second]), found.pose[None], information[None], np.array([True]))
