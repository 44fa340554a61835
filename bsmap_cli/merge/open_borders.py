"""Open borders with as few vertices as they are known by: a face ends there with the last beams, centimetres apart."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from bsmap_cli.core.polygons import simplify
from bsmap_cli.merge.rings import Ring
from bsmap_cli.merge.shapes import Shape, flattened_ring
from bsmap_cli.model import Array, IntArray

TOLERANCE = 0.01
"""Metres by which a simplified open border may leave what it was."""


def fewer_vertices(rings: Sequence[Ring], shape: Shape) -> list[Ring]:
    """Rings of a face, the vertices of their open borders thinned out; those that creases hold stay."""
    return [_fewer(ring, flattened_ring(shape, ring.points)) for ring in rings]


def _fewer(ring: Ring, flat: Array) -> Ring:
    """One ring, flat : (k, 2) its points in the plane; as it was where hardly anything of it would be left."""
    n, fixed = len(flat), _fixed(ring, flat)
    keep = np.zeros(n, dtype=bool)
    for start, stop in pairwise([*fixed.tolist(), int(fixed[0]) + n]):
        chain = np.arange(start, stop + 1) % n
        keep[chain] |= simplify(flat[chain], TOLERANCE)
    return ring.of(keep) if np.count_nonzero(keep) > 2 else ring


def _fixed(ring: Ring, flat: Array) -> IntArray:
    """Vertices that stay: those at creases and rims; of a ring without the first one, and the one farthest from it."""
    known = ring.edges >= 0 if ring.rims is None else (ring.edges >= 0) | (ring.rims > 0.0)
    held = np.flatnonzero(known | np.roll(known, 1))
    if len(held):
        return held
    return np.array([0, int(np.argmax(np.linalg.norm(flat - flat[0], axis=1)))])
