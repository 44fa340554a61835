"""Samples of a surface with a tree over them: where a projection starts, and which other starts it has to try."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from bsmap_cli.core.basis import Surface
from bsmap_cli.core.bspline import evaluate_grid
from bsmap_cli.core.pieces import Pieces, polynomial_pieces
from bsmap_cli.model import Array

OFFSET = 0.75
"""Share of a cell's diagonal by which a foot may lie beside its sample."""
SAMPLES = 64
"""Samples along the longer direction at which long spans stop being divided further."""
TURN = 0.25
"""Radians that a span turns for one part more than its degree + 1: fewer, and Newton leaves the valley it starts in."""
COARSER = 3
"""Step from fine samples to coarse ones."""


class SampleGrid(NamedTuple):
    """Points of a surface on a grid of parameters.

    u : (k,), v : (l,) parameters of the grid.  tree : of its k l points, v fastest.
    reach : (k l,) metres, diagonal of the widest cell around each sample.
    """

    u: Array
    v: Array
    tree: cKDTree
    reach: Array

    def parameters(self, index: NDArray[np.intp]) -> Array:
        """Parameters (2, n) of samples."""
        row, column = np.divmod(index, len(self.v))
        return np.stack([self.u[row], self.v[column]])

    def closest(self, uv: Array) -> NDArray[np.intp]:
        """Samples (n,) whose parameters are closest to uv (2, n)."""
        row = ((self.u[1:] + self.u[:-1]) / 2).searchsorted(uv[0])
        return row * len(self.v) + ((self.v[1:] + self.v[:-1]) / 2).searchsorted(uv[1])

    def nearest(self, points: Array, count: int) -> tuple[Array, NDArray[np.intp]]:
        """Distances and numbers (k, n) of the k = `count` samples nearest to points (n, 3), or of all there are."""
        distance, sample = self.tree.query(points, k=range(1, min(count, len(self.reach)) + 1))
        return np.ascontiguousarray(np.transpose(distance)), np.ascontiguousarray(np.transpose(sample))

    def apart(self, first: NDArray[np.intp], second: NDArray[np.intp]) -> NDArray[np.bool_]:
        """True where two samples are not neighbours on the grid."""
        (row, column), (other_row, other_column) = (np.divmod(index, len(self.v)) for index in (first, second))
        return (np.abs(row - other_row) > 1) | (np.abs(column - other_column) > 1)


class Samples(NamedTuple):
    """Polynomial pieces of a surface, fine samples of it, and every third of them."""

    pieces: Pieces
    fine: SampleGrid
    coarse: SampleGrid


def sample_surface(surface: Surface) -> Samples:
    """Samples of a surface; make them once where many batches are projected on the same surface."""
    spans = [
        _spans(surface.knots_u, surface.degree_u, surface.control_points),
        _spans(surface.knots_v, surface.degree_v, np.swapaxes(surface.control_points, 0, 1)),
    ]
    spacing = max(span.lengths.sum() for span in spans) / SAMPLES
    u = _divide(spans[0], spacing, surface.degree_u)
    v = _divide(spans[1], spacing, surface.degree_v)
    points = evaluate_grid(surface, u, v)
    i, j = _every_third(len(u)), _every_third(len(v))
    fine, coarse = _sample_grid(u, v, points), _sample_grid(u[i], v[j], points[np.ix_(i, j)])
    return Samples(polynomial_pieces(surface), fine, coarse)


def _every_third(count: int) -> NDArray[np.intp]:
    return np.unique(np.append(np.arange(0, count, COARSER), count - 1))


def _sample_grid(u: Array, v: Array, points: Array) -> SampleGrid:
    tree = cKDTree(points.reshape(-1, 3), balanced_tree=False, compact_nodes=False)
    squared = _widest(points, 0) + _widest(points, 1)
    return SampleGrid(u, v, tree, np.sqrt(squared).ravel())


def _widest(points: Array, axis: int) -> Array:
    """Squared length (k, l) of the longer of both steps along an axis at each point of a grid (k, l, 3)."""
    step = np.diff(points, axis=axis)
    squared = np.moveaxis(np.einsum("ijd,ijd->ij", step, step), axis, 0)
    widest = np.zeros((len(squared) + 1, squared.shape[1]))
    widest[:-1] = squared
    np.maximum(widest[1:], squared, out=widest[1:])
    return np.moveaxis(widest, 0, axis)


class _Spans(NamedTuple):
    """Spans along one direction: ends (k + 1,), lengths (k,) in metres, and how far they turn (k,) in radians."""

    ends: Array
    lengths: Array
    turns: Array


def _spans(knots: Array, degree: int, control_points: Array) -> _Spans:
    """By the control polygons: of the legs the longest over the other direction counts, of the angles the mean."""
    ends = np.unique(knots)
    steps = np.diff(control_points, axis=0)
    legs = np.sqrt(np.einsum("ijd,ijd->ij", steps, steps))
    product = legs[1:] * legs[:-1]
    cosines = np.einsum("ijd,ijd->ij", steps[1:], steps[:-1]) / np.where(product > 0.0, product, np.inf)
    angles = np.where(product > 0.0, np.arccos(np.clip(cosines, -1.0, 1.0)), 0.0)
    greville = np.lib.stride_tricks.sliding_window_view(knots[1:-1], degree).mean(axis=1)
    lengths = np.interp(ends, greville, np.append(0.0, np.cumsum(legs.max(axis=1))))
    turns = np.interp(ends, (greville[1:] + greville[:-1]) / 2, np.append(0.0, np.cumsum(angles.mean(axis=1))))
    return _Spans(ends, np.diff(lengths), np.diff(turns))


def _divide(spans: _Spans, spacing: float, degree: int) -> Array:
    """Parameters that divide each span into equal parts, no longer than `spacing` and no fewer than its shape needs."""
    ends = spans.ends
    shape = degree + 1 + np.floor(spans.turns / TURN)
    parts = np.maximum(np.ceil(spans.lengths / max(spacing, 1e-300)), shape).astype(int)
    number = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    inside = np.repeat(ends[:-1], parts) + number * np.repeat(np.diff(ends) / parts, parts)
    return np.append(inside, 1.0)
