"""Linear equations of the heights of a field, about the feet that its own beams have on it."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import design_matrix
from bsmap_cli.core.knots import find_spans
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.feet import Met, meet, tabulate
from bsmap_cli.fit.heights import HeightField, Knots, bulge_of, least_knots
from bsmap_cli.model import Array, IntArray

ROBUST = 3.0
"""Standard deviations beyond which a block counts less (Huber)."""
MANY = 8
"""Control points along s from which each span is worked on for itself."""
CHUNK = 2048
"""Rows of the equations that are worked on at a time."""


class Equations(NamedTuple):
    """Feet (n,) of the blocks; heights wanted there and roots of the weights, standard deviations.

    square : of all heights wanted.  places : along s and t, number of distinct parameters, to a thousandth.
    least : knots of the least surface.  size : (2,) metres of the rectangle along s and t.
    bases : basis functions at the feet that were computed so far, by direction, degree and knots; along s times `root`.
    """

    feet: Met
    wanted: Array
    root: Array
    square: float
    places: tuple[int, int]
    least: Knots
    size: Array
    bases: dict[tuple[int, int, bytes], Array]

    def basis(self, axis: int, degree: int, knots: Array) -> Array:
        """(n, k) basis functions along s (0), weighted, or t (1)."""
        key = axis, degree, knots.tobytes()
        if key not in self.bases:
            values = design_matrix(knots, degree, np.clip(self.feet.uv[:, axis], 0.0, 1.0))
            self.bases[key] = values if axis else values * self.root[:, None]
        return self.bases[key]


def linearise(field: HeightField, blocks: Blocks, sigma: float, near: Equations | None = None) -> Equations:
    """Linear equations about a field's own feet; near: those of one near it."""
    only = np.zeros(len(blocks.counts), dtype=np.int64)
    start = None if near is None else near.feet.beyond
    feet = meet(tabulate([field]), only, blocks.points, blocks.directions, start=start)
    wanted = feet.height - feet.slope * feet.beyond
    bulge = bulge_of(field.base)
    if bulge is not None:
        wanted -= bulge.over(field.low[1] + feet.uv[:, 1] * (field.high[1] - field.low[1]))[0]
    root = np.sqrt(blocks.counts) / sigma
    size = np.abs(feet.beyond) * root
    # What does not fit yet is no outlier: the scale is that of the residuals.
    scale = max(1.0, float(np.median(size)) / 0.6745)
    robust = np.sqrt(np.minimum(1.0, ROBUST * scale / np.maximum(size, 1e-12)))
    root = root * robust / np.abs(feet.slope)
    places = number_of_places(feet.uv[:, 0]), number_of_places(feet.uv[:, 1])
    least = least_knots(field.base, field.low, field.high)
    wanted = wanted * root
    return Equations(feet, wanted, root, float(wanted @ wanted), places, least, field.high - field.low, {})


def number_of_places(u: Array) -> int:
    """Number of distinct parameters (n,), clamped to [0, 1], to a thousandth."""
    return int(np.count_nonzero(np.bincount(np.rint(np.clip(u, 0.0, 1.0) * 1000.0).astype(np.int64))))


def normal_equations(knots: Knots, data: Equations) -> tuple[Array, Array]:
    """(k, k) and (k,): products of the basis functions' products with each other, and with the heights wanted."""
    along_s, along_t = data.basis(0, knots.degree_s, knots.s), data.basis(1, knots.degree_t, knots.t)
    nt = knots.shape[1]
    if len(data.root) <= CHUNK and knots.shape[0] < MANY:
        N = (along_s[:, :, None] * along_t[:, None, :]).reshape(-1, knots.size)
        return N.T @ N, data.wanted @ N
    A, b = np.zeros((knots.size, knots.size)), np.zeros(knots.size)
    for rows, own in _parts(knots, data):
        N = (along_s[rows, own, None] * along_t[rows, None, :]).reshape(-1, (own.stop - own.start) * nt)
        there = slice(own.start * nt, own.stop * nt)
        A[there, there] += N.T @ N
        b[there] += data.wanted[rows] @ N
    return A, b


def _parts(knots: Knots, data: Equations) -> Iterator[tuple[slice | IntArray, slice]]:
    """Rows of the equations worked on at a time, which fit into the cache, and the functions along s that they need.

    Where there are many spans along s, the rows of each are taken for themselves: the others' functions are 0 there.
    """
    ns, degree = knots.shape[0], knots.degree_s
    if ns < MANY:
        yield from ((slice(first, first + CHUNK), slice(0, ns)) for first in range(0, len(data.root), CHUNK))
        return
    span = find_spans(knots.s, degree, np.clip(data.feet.uv[:, 0], 0.0, 1.0)) - degree
    order = np.argsort(span, kind="stable")
    for first, rows in enumerate(np.split(order, np.cumsum(np.bincount(span, minlength=ns - degree))[:-1])):
        yield rows, slice(first, first + degree + 1)


def misfits(knots: Knots, heights: Array, data: Equations) -> Array:
    """(n,) by how much heights (k,) miss those wanted, standard deviations."""
    along_s, along_t = data.basis(0, knots.degree_s, knots.s), data.basis(1, knots.degree_t, knots.t)
    return np.einsum("nk,nk->n", along_s @ heights.reshape(knots.shape), along_t) - data.wanted
