"""Outlines that double back on themselves, or cross, made simple again: vertices that no crease holds are left out."""

from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray

from bsmap_cli.core.polygons import signed_area
from bsmap_cli.merge.rings import Ring
from bsmap_cli.merge.shapes import Shape, flattened_ring
from bsmap_cli.model import Array, IntArray

THIN = 0.005
"""Metres from where an outline comes back to the side that it doubles: less has no surface between."""
MOST = 50
"""Vertices left out of the outlines of one face for their crossings, at most."""


def untangled(rings: Sequence[Ring], shape: Shape) -> list[Ring]:
    """Rings of a face that neither double back nor cross, as far as vertices that no crease holds make them so."""
    out = [_without_spikes(ring, flattened_ring(shape, ring.points)) for ring in rings]
    flat = [flattened_ring(shape, ring.points) for ring in out]
    for _ in range(MOST):
        crossings = _crossings(flat)
        better = _without_crossing(out, flat, crossings) if len(crossings) else None
        if better is None:
            break
        ring, vertex = better
        out[ring], flat[ring] = _without(out[ring], vertex), np.delete(flat[ring], vertex, axis=0)
    return out


def _free(edges: IntArray) -> NDArray[np.bool_]:
    """Which vertices (k,) no crease holds."""
    return (edges < 0) & (np.roll(edges, 1) < 0)


def _without(ring: Ring, vertex: int) -> Ring:
    return ring.of(np.arange(len(ring.edges)) != vertex % len(ring.edges))


def _without_spikes(ring: Ring, flat: Array) -> Ring:
    """The ring without vertices at or behind which it doubles back; flat : (k, 2) its points in the plane."""
    while len(flat) > 3:
        spikes = _spikes(flat, ring.edges)
        if not len(spikes):
            break
        ring, flat = _without(ring, spikes[0]), np.delete(flat, spikes[0], axis=0)
    return ring


def _spikes(flat: Array, edges: IntArray) -> list[int]:
    """Vertices to leave out: those at which the outline turns back, or the end of the shorter side there."""
    on, back = np.roll(flat, -1, axis=0) - flat, np.roll(flat, 1, axis=0) - flat
    lengths = np.linalg.norm(on, axis=1), np.linalg.norm(back, axis=1)
    across = np.abs(on[:, 0] * back[:, 1] - on[:, 1] * back[:, 0]) / np.maximum(np.maximum(*lengths), 1e-12)
    free, n = _free(edges), len(flat)
    found = []
    for k in np.flatnonzero((np.sum(on * back, axis=1) > 0.0) & (across < THIN)).tolist():
        shorter = (k + 1) % n if lengths[0][k] < lengths[1][k] else k - 1
        found += [vertex % n for vertex in (k, shorter) if free[vertex]][:1]
    return found


def _sides(flat: Sequence[Array]) -> tuple[IntArray, Array]:
    """Ring and vertex (n, 2) at which sides start, and their ends (n, 2, 2)."""
    where = [np.column_stack([np.full(len(loop), number), np.arange(len(loop))]) for number, loop in enumerate(flat)]
    return np.concatenate(where), np.concatenate([np.stack([loop, np.roll(loop, -1, axis=0)], axis=1) for loop in flat])


def _crossings(flat: Sequence[Array]) -> IntArray:
    """(n, 2, 2) rings and vertices at which two sides start that cross each other inside."""
    where, ends = _sides(flat)
    lines = shapely.linestrings(ends)
    a, b = shapely.STRtree(lines).query(lines, predicate="crosses")
    return where[np.column_stack([a, b])[a < b]]


def _without_crossing(rings: Sequence[Ring], flat: Sequence[Array], crossings: IntArray) -> tuple[int, int] | None:
    """Ring and vertex without which the fewest crossings are left, by the least area; None where none helps."""
    best, least = None, (len(crossings), 0.0)
    tried = {(r, (v + step) % len(flat[r])) for r, v in crossings.reshape(-1, 2).tolist() for step in (0, 1)}
    for ring, vertex in sorted(tried):
        if _free(rings[ring].edges)[vertex] and len(flat[ring]) > 3:
            left = [np.delete(loop, vertex, axis=0) if number == ring else loop for number, loop in enumerate(flat)]
            area = abs(float(signed_area(flat[ring][[vertex - 1, vertex, (vertex + 1) % len(flat[ring])]])))
            if (cost := (len(_crossings(left)), area)) < least:
                best, least = (ring, vertex), cost
    return best
