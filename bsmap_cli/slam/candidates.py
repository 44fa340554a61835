"""Places that may be the same ones seen before, by where the poses have them."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from bsmap_cli.core.table import take
from bsmap_cli.model import Array
from bsmap_cli.slam.posegraph import Edges
from bsmap_cli.slam.recognition import LEAST_WAY, REACH
from bsmap_cli.slam.submaps import Search

DRIFT, MOST_REACH = 0.02, 10.0
"""A place counts as near within REACH metres, and DRIFT more for each metre of way since, up to MOST_REACH."""
WIDE_DRIFT, WIDE_REACH, LINK, POOR_LINK = 0.04, 20.0, 0.1, 20.0
"""The same for wide searches, by the shortest way along the graph; metres that a closure counts there, and that a poor
match counts more than its way."""
UNHELD = 10.0
"""Metres of way from any closure from which on a key scan may be off by twice REACH whatever the way."""
PASSES = 3
"""Earlier visits to a place that are tried, nearest first."""

Candidate = tuple[int, int, float]
"""Key scan, an earlier one, and metres about the guess within which it may be."""


def near_candidates(look: Search, spacing: float) -> Iterator[Candidate]:
    """Every `spacing` metres of way, the nearest key scan of the nearest earlier visits."""
    for here in _spaced(look.way, spacing):
        since = look.way[here] - look.way[:here]
        reach = np.minimum(REACH + DRIFT * since, MOST_REACH)
        yield from _nearest(look, here, np.where(since > LEAST_WAY, reach, 0.0))


def far_candidates(look: Search, spacing: float, edges: Edges) -> Iterator[Candidate]:
    """The same for places that may be farther apart than the poses tell.

    The edges join these by so long a way only, or a key scan is far from all that closures hold.
    """
    n = len(look.poses)
    loops = is_loop(look.poses, edges)
    length = np.hypot(edges.relative[:, 0], edges.relative[:, 1]) + np.where(edges.robust, POOR_LINK, LINK)
    length[loops] = LINK
    graph = sparse.csr_matrix((length, (edges.first, edges.second)), shape=(n, n))
    doubt = np.where(_unheld(take(edges, loops), look.way), 2 * REACH, 0.0)
    for here in _spaced(look.way, spacing):
        apart = dijkstra(graph, directed=False, indices=np.array([here]))[0, :here]
        reach = np.minimum(doubt[here] + WIDE_DRIFT * apart, WIDE_REACH)
        far = (reach > REACH) & (look.way[here] - look.way[:here] > LEAST_WAY)
        yield from _nearest(look, here, np.where(far, reach, 0.0))


def is_loop(poses: Array, edges: Edges) -> NDArray[np.bool_]:
    """(m,) edges with so much way along the poses (n, 3) between their ends that they close a loop.

    The others lead past scans that could not be matched.
    """
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))])
    return np.asarray(way[edges.second] - way[edges.first] > LEAST_WAY)


def _unheld(closures: Edges, way: Array) -> NDArray[np.bool_]:
    """(n,) key scans that are a long way from any that a closure holds."""
    held = np.sort(way[np.concatenate([closures.first, closures.second])])
    if len(held) == 0:
        return np.ones(len(way), bool)
    after = np.searchsorted(held, way)
    nearest = [np.abs(way - held[k.clip(0, len(held) - 1)]) for k in (after - 1, after)]
    return np.asarray(np.minimum(*nearest) > UNHELD)


def _spaced(way: Array, spacing: float) -> Iterator[int]:
    """Key scans every so many metres of way."""
    next_way = 0.0
    for here, now in enumerate(way.tolist()):
        if now >= next_way:
            next_way = now + spacing
            yield here


def _nearest(look: Search, here: int, reach: Array) -> Iterator[Candidate]:
    """Of each of the nearest visits with places within `reach` (here,), the nearest place."""
    distance = np.hypot(*(look.poses[:here, :2] - look.poses[here, :2]).T)
    near = np.flatnonzero(distance < reach)
    if len(near) == 0:
        return
    visits = np.split(near, np.flatnonzero(np.diff(look.way[near]) > 2 * REACH) + 1)
    nearest = sorted((visit[np.argmin(distance[visit])] for visit in visits), key=lambda j: distance[j])
    for before in nearest[:PASSES]:
        yield here, int(before), float(reach[before])
