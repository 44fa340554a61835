"""Whether meshes of faces that share creases have the very same vertices along them, and how far they gape where not.

A crease is a chain of points. Between two of them that follow each other the border of a face's mesh must be a chain of
edges, too, and that of the other face must be the same to the last bit.
"""

import itertools
from collections import defaultdict, deque
from typing import NamedTuple

import numpy as np
from true_edges import distance_to_lines

FARTHEST = 0.05
"""Metres from a side of a crease that borders of curved faces may run; what is farther off does not run along it."""


class Seams(NamedTuple):
    """sides: of all creases.  open: those along which a face has no border, or another chain than the other face.

    gap : largest distance in metres of a vertex of one chain to the other chain, or of a side to the border of a face
    that does not run along it.
    """

    sides: int
    open: int
    gap: float


class Borders:
    """Edges of a mesh that one triangle has: each vertex (a tuple) leads to its neighbours."""

    def __init__(self, mesh):
        edges = np.sort(np.concatenate([mesh.triangles[:, k] for k in ([0, 1], [1, 2], [2, 0])]), axis=1)
        single, count = np.unique(edges, axis=0, return_counts=True)
        self.lines = mesh.vertices[single[count == 1]]
        self.next = defaultdict(set)
        for a, b in self.lines.tolist():
            self.next[tuple(a)].add(tuple(b))
            self.next[tuple(b)].add(tuple(a))

    def chain(self, start, end):
        """Vertices (k, 3) along the border, the fewest from start to end near the straight line; else None."""
        start, end = tuple(start.tolist()), tuple(end.tolist())
        before, waiting = {start: start}, deque([start])
        while waiting and end not in before:
            here = waiting.popleft()
            for there in sorted(self.next.get(here, ())):
                if there not in before and self._beside(there, start, end):
                    before[there] = here
                    waiting.append(there)
        if end not in before:
            return None
        out = [end]
        while out[-1] != start:
            out.append(before[out[-1]])
        return np.array(out[::-1])

    def runs_along(self, chain):
        """Whether the border has the edges from each vertex (k, 3) of a chain to the next, among others."""
        places = [tuple(place) for place in chain.tolist()]
        return all(b in self.next.get(a, ()) for a, b in itertools.pairwise(places))

    @staticmethod
    def _beside(point, start, end):
        return distance_to_lines(np.array([point]), [np.array([start, end])])[0] < FARTHEST

    def distance(self, points):
        return float(distance_to_lines(points, list(self.lines)).max())


def seams(creases, meshes):
    """Seams of creases between meshes, by the names of their surfaces."""
    borders = {name: Borders(mesh) for name, mesh in meshes.items()}
    sides, gaps = 0, []
    for crease in creases:
        both = [borders[name] for name in crease.surfaces]
        for start, end in zip(crease.points[:-1], crease.points[1:], strict=True):
            sides += 1
            one, other = (border.chain(start, end) for border in both)
            if one is not None and other is not None:
                if not both[1].runs_along(one) and not both[0].runs_along(other):
                    gaps.append(max(distance_to_lines(one, [other]).max(), distance_to_lines(other, [one]).max()))
            else:
                line = np.linspace(start, end, 9)
                gaps.append(max(b.distance(line) for b, c in zip(both, (one, other), strict=True) if c is None))
    return Seams(sides, len(gaps), float(max(gaps, default=0.0)))
