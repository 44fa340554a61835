"""What growing regions needs to know of the pieces: their block means, own chi square, and neighbours."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.blocks import Blocks, make_blocks
from bsmap_cli.fit.lowmodels import GRAZING, Sums, chi_squares
from bsmap_cli.fit.pieces import Pieces
from bsmap_cli.model import Array, IntArray

PRICE = 8.0
"""Of a parameter, in chi square."""
SLACK = 0.05
"""Chi square a beam that a joint surface may be worse, for noise is not quite white."""
FLATNESS = 0.004
"""Metres by which a real wall may leave a polynomial without being two."""
JUMP = 10.0
"""Standard deviations that a jump is longer than the steps of a surface that beams graze."""
LEAST_OVERLAP = 0.3
"""Share of the shorter of two pieces of neighbouring scans that lies before beams of the other."""


class Context(NamedTuple):
    """Pieces with what growing needs.

    blocks : of all pieces, in their order.  first : (k + 1,) first block of each piece.
    chi : (k,) chi square of each piece about its own line.  price : (k,) of its parameters.  beams : (k,) its returns.
    neighbours : of each piece, those one or two scans away before the same beams.  parted : of each, those of them from
    which a jump parts it; they are not among its neighbours.
    sigma : metres, noise along the beam that block means show, in terms of single beams.
    """

    pieces: Pieces
    blocks: Blocks
    first: IntArray
    chi: Array
    price: Array
    beams: Array
    neighbours: list[list[int]]
    parted: list[list[int]]
    sigma: float

    @property
    def slack(self) -> float:
        """Chi square a beam that a joint surface may be worse."""
        return max(SLACK, (FLATNESS / self.sigma) ** 2)

    def blocks_of(self, members: Sequence[int]) -> Blocks:
        """Blocks of the pieces `members`."""
        return self.blocks.pick(np.concatenate([np.arange(self.first[k], self.first[k + 1]) for k in members]))


def make_context(grid: BeamGrid, pieces: Pieces) -> Context:
    """Context of all pieces of a data set."""
    blocks = make_blocks(grid, pieces.row, pieces.start, pieces.stop)
    first = np.searchsorted(blocks.owner, np.arange(len(pieces.row) + 1))
    price = PRICE * np.where(pieces.curved, 3.0, 2.0)
    size = np.where(pieces.curved, 3, 2)
    chi = _own_chi(blocks, size, grid.sigma)
    count = np.bincount(blocks.owner, blocks.counts, len(pieces.row)).astype(np.float64)
    inflation = _inflation(chi, np.diff(first) - size)
    sigma = grid.sigma * np.sqrt(inflation)
    return Context(pieces, blocks, first, chi / inflation, price, count, *_neighbours(grid, pieces), sigma)


def _inflation(chi: Array, freedom: IntArray) -> float:
    """Variance of block means over that of white noise, 1 or more: real noise is alike in neighbouring beams."""
    known = freedom >= 4
    if np.count_nonzero(known) < 5:
        return 1.0
    ratio, weight = chi[known] / freedom[known], freedom[known]
    order = np.argsort(ratio)
    half = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
    return float(max(1.0, ratio[order][half]))


def _own_chi(blocks: Blocks, size: IntArray, sigma: float) -> Array:
    """Chi square (k,) of the blocks of each piece about its own line (`size` 2) or parabola (3), over its chord."""
    number = np.bincount(blocks.owner, minlength=len(size))
    known = np.flatnonzero(number > size)
    out = np.zeros(len(size))
    if not len(known):
        return out
    part = blocks.pick(np.flatnonzero((number > size)[blocks.owner]))
    first = np.concatenate([[0], np.cumsum(number[known])])
    of = np.repeat(np.arange(len(known)), number[known])
    mean = np.add.reduceat(np.column_stack([part.points, part.directions]), first[:-1]) / number[known, None]
    chord = part.points[first[1:] - 1] - part.points[first[:-1]]
    chord /= np.linalg.norm(chord, axis=1, keepdims=True)
    normal = np.cross(np.cross(chord, mean[:, 3:]), chord)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    centred = part.points - mean[of, :3]
    along, height = np.sum(centred * chord[of], axis=1), np.sum(centred * normal[of], axis=1)
    root = np.sqrt(part.counts) / sigma / np.maximum(np.abs(np.sum(part.directions * normal[of], axis=1)), 0.05)
    N = np.stack([root, root * along, np.where(size[known][of] == 3, root * along**2, 0.0)], axis=1)
    A = np.add.reduceat(N[:, :, None] * N[:, None, :], first[:-1])
    A[size[known] == 2, 2, 2] = 1.0
    x = np.linalg.solve(A, np.add.reduceat(N * (height * root)[:, None], first[:-1])[:, :, None])[:, :, 0]
    out[known] = np.add.reduceat((np.sum(N * x[of], axis=1) - height * root) ** 2, first[:-1])
    return out


def _neighbours(grid: BeamGrid, pieces: Pieces) -> tuple[list[list[int]], list[list[int]]]:
    """For each piece those one or two scans away whose beams overlap its own and that no jump parts from it; and those
    that one does, before or behind it in its own scan, too.
    """
    near: list[list[int]] = [[] for _ in pieces.row]
    parted: list[list[int]] = [[] for _ in pieces.row]
    pairs, beams = _overlapping(pieces)
    jumps = _parted(grid, pieces, pairs, np.column_stack([beams, beams]))
    following = np.flatnonzero(pieces.row[1:] == pieces.row[:-1])
    beside = np.column_stack([following, following + 1])
    ends = np.column_stack([pieces.stop[following] - 1, pieces.start[following + 1]])
    for lists, some in (
        (near, pairs[~jumps]),
        (parted, pairs[jumps]),
        (parted, beside[_parted(grid, pieces, beside, ends)]),
    ):
        for one, other in some.tolist():
            lists[one].append(other)
            lists[other].append(one)
    return near, parted


def _overlapping(pieces: Pieces) -> tuple[IntArray, IntArray]:
    """Pairs (n, 2) of pieces one or two scans apart before about the same beams, and the middle one (n,) of these."""
    pairs, beams = [np.zeros((0, 2), dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    rows = int(pieces.row.max(initial=-1)) + 1
    bounds = np.searchsorted(pieces.row, np.arange(rows + 1))
    for step in (1, 2):
        for row in range(rows - step):
            a, b = (np.arange(bounds[r], bounds[r + 1]) for r in (row, row + step))
            first = np.maximum(pieces.start[a][:, None], pieces.start[b])
            common = np.minimum(pieces.stop[a][:, None], pieces.stop[b]) - first
            shorter = np.minimum((pieces.stop - pieces.start)[a][:, None], (pieces.stop - pieces.start)[b])
            i, j = np.nonzero(common >= np.maximum(2, LEAST_OVERLAP * shorter))
            pairs.append(np.column_stack([a[i], b[j]]))
            beams.append(first[i, j] + common[i, j] // 2)
    return np.concatenate(pairs), np.concatenate(beams)


def _parted(grid: BeamGrid, pieces: Pieces, pairs: IntArray, beams: IntArray) -> NDArray[np.bool_]:
    """(n,) whether the ends of two beams (n, 2), one of each piece of pairs (n, 2), are so far apart along the beam
    that a surface through both would graze it: one of the pieces stands before the other.
    """
    rows = pieces.row[pairs]
    one, other = (grid.points[rows[:, k], beams[:, k]] for k in (0, 1))
    ways = grid.directions[rows[:, 0], beams[:, 0]]
    between = other - one
    along = np.sum(between * ways, axis=1)
    across = np.linalg.norm(between - along[:, None] * ways, axis=1)
    return np.asarray(np.abs(along) > across / GRAZING + JUMP * grid.sigma, dtype=bool)


def joint_excess(context: Context, members: list[int], sums: Sums, size: int) -> float:
    """By how much a joint surface is worse than the pieces apart, prices and slack included; negative: better."""
    apart = sum(context.chi[k] + context.price[k] + context.slack * context.beams[k] for k in members)
    return float(chi_squares(sums, (size,))[0]) + PRICE * size - float(apart)
