"""Rims: where a face ends because the thing has an edge there, though the face beyond that edge is not known.

The edge stands between the last beam on the face and the next one, which passed its place: both bracket it. What the
next beam hits lies behind the face; or a few beams that are too few for a face lead on from it step by step to another
one. Whatever else ends a face tells of no edge: the shadow of what stands before it, the end of range or field of view.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.lines import straight_line
from bsmap_cli.core.polygons import simplify
from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.crossings import Crossings
from bsmap_cli.fit.feet import STEEPEST, Table
from bsmap_cli.fit.labels import ADOPTED, OUTLIER, met_at
from bsmap_cli.model import Array, IntArray

WIDEST = 0.06
"""Metres between the feet of two beams on a face, beyond which nobody knows where between them it ends."""
LED = 0.02
"""Metres by which a face is led on from its last beam to the middle of the bracket, at most."""
BEHIND = 0.01
"""Metres beyond the noise by which another face's beam lies behind a face, or before it."""
FEW = 4
"""Beams at most that lead from a face to another one."""
TURNED = 0.3
"""Least sine between beams and a round face that ends: in less it may turn away instead."""
STRIDE, SHARE = 0.1, 0.6
"""Metres, and share of the way between both faces, that one step of those may be at most."""


class _Found(NamedTuple):
    """Rims on edges of the grid: their first beams, the faces (k,) that end, brackets' middles (k, 3), widths (k,)."""

    row: IntArray
    column: IntArray
    face: IntArray
    points: Array
    widths: Array


def with_rims(grid: BeamGrid, labels: IntArray, table: Table, crossings: Crossings) -> Crossings:
    """Crossings, and rims as such of one face, with -1 in the place of the other one.

    The grid's points lie on their faces.
    """
    numbers = [crossings.along.copy(), crossings.across.copy()]
    points, faces, widths = [crossings.points], [crossings.faces], [crossings.widths]
    count = len(crossings.points)
    for kind, step in enumerate(((0, 1), (1, 0))):
        for towards in (1, -1):
            for few in range(FEW + 1 if kind == 0 else 1):
                found = _ends(grid, labels, table, numbers[kind], step, towards, few)
                numbers[kind][found.row, found.column] = count + np.arange(len(found.row))
                count += len(found.row)
                points.append(found.points)
                faces.append(np.column_stack([found.face, np.full(len(found.face), -1)]))
                widths.append(found.widths)
    pairs = np.concatenate(faces)
    passed = np.zeros(pairs.shape, dtype=bool)
    passed[: len(crossings.passed)] = crossings.passed
    return Crossings(numbers[0], numbers[1], np.concatenate(points), pairs, passed, np.concatenate(widths))


def _ends(
    grid: BeamGrid, labels: IntArray, table: Table, number: IntArray, step: tuple[int, int], towards: int, few: int
) -> _Found:
    """Rims on edges to the next beam or scan that have no number yet.

    towards : +1 where the face of the edge's first beam ends, -1 that of its second one.
    few : so many beams of no face follow on the last one of the face, and then one of another face; 0 for none.
    """
    (m, n), far = labels.shape, few + 1
    down, right = step
    places = np.indices((m - down * far, n - right * far)).reshape(2, -1)
    chain = [places + k * np.array([[down], [right]]) for k in range(far + 1)][::towards]
    own, last = (labels[*chain[k]] for k in (0, -1))
    good = (own >= 0) & (own != last) & np.all([grid.hit[*at] for at in chain], axis=0)
    good &= np.all([labels[*at] < 0 for at in chain[1:-1]], axis=0) if few else True
    edge = np.minimum(chain[0], chain[1])
    good &= number[*edge] < 0
    good &= last >= 0 if few else True
    chain, own, edge = [at[:, good] for at in chain], own[good], edge[:, good]
    here = grid.points[*chain[0]]
    met = [met_at(grid, table, own, *at) for at in chain[1:]]
    beyond = np.stack([m.beyond for m in met])
    ends = _leads_on(grid, chain, beyond) if few else _behind(grid, labels[*chain[1]], beyond[0])
    # Of a few beams that are on neither face, those within the noise may be on this one.
    off = np.abs(beyond[:-1]) > ADOPTED * grid.sigma
    first = np.where(off.any(axis=0), np.argmax(off, axis=0) if few else 0, few)
    at = np.stack(chain[1:])[first, :, np.arange(len(own))].T
    past = grid.points[*at] + beyond[first, np.arange(len(own))][:, None] * grid.directions[*at]
    width = np.linalg.norm(past - here, axis=1)
    slope = np.min([np.abs(m.slope) for m in met], axis=0)
    round_ = (table.radius[own] > 0.0) | np.isfinite(table.least[own])
    slope = np.minimum(slope, np.where(round_, np.abs(met_at(grid, table, own, *chain[0]).slope), np.inf))
    k = np.flatnonzero(ends & (slope > np.where(round_, TURNED, STEEPEST)) & (width < WIDEST) & (width > 0.0))
    led = np.minimum(0.5, LED / width[k])[:, None]
    return _Found(edge[0, k], edge[1, k], own[k], here[k] + led * (past - here)[k], width[k])


def _behind(grid: BeamGrid, labels: IntArray, beyond: Array) -> NDArray[np.bool_]:
    """Whether beams (k,) hit what lies behind a face, so many metres before which they end."""
    return np.asarray(beyond < -BEHIND - np.where(labels >= 0, grid.sigma, OUTLIER * grid.sigma))


def _leads_on(grid: BeamGrid, chain: list[IntArray], beyond: Array) -> NDArray[np.bool_]:
    """Whether beams lead on, each (2, k), from the faces that the first ones are on to others, behind or before.

    Behind, none of those between lies before the face; before it, they lead there step by step.
    beyond : (few + 1, k) metres from the ends of the following beams on to the face.
    """
    off = BEHIND + grid.sigma
    behind = (beyond[-1] < -off) & np.all(beyond[:-1] < OUTLIER * grid.sigma, axis=0)
    points = np.stack([grid.points[*at] for at in chain])
    strides = np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=0)
    steady = (strides < STRIDE) & (strides < SHARE * np.linalg.norm(points[-1] - points[0], axis=1))
    return np.asarray(behind | ((beyond[-1] > off) & (beyond[0] > -OUTLIER * grid.sigma) & steady))


def straightened(points: Array, widths: Array) -> Array:
    """A rim (k, 2) with fewer vertices (j, 2): straight lines that keep about within half the brackets (k,)."""
    kept = np.flatnonzero(simplify(points, min(LED, 0.5 * float(np.median(widths)))))
    lines = [straight_line(points[first : last + 1]) for first, last in itertools.pairwise(kept.tolist())]
    starts, ends = (
        [middle + ((points[k] - middle) @ way) * way for (middle, way), k in zip(lines, at.tolist(), strict=True)]
        for at in (kept[:-1], kept[1:])
    )
    inner = [(end + start) / 2.0 for end, start in zip(ends[:-1], starts[1:], strict=True)]
    return np.array([starts[0], *inner, ends[-1]])
