"""Seeds of regions: pieces of successive scans that lie on one low-order surface, the surest kinds first."""

from collections.abc import Iterator

import numpy as np

from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.context import Context, joint_excess
from bsmap_cli.fit.lowmodels import Frame, PlaneFrame, fit_cylinder_frame, fit_plane_frame, sums_of
from bsmap_cli.model import Array, IntArray

SEED_INCIDENCE = 0.15
"""Sine between beams and the surface of a seed; flatter ones bridge jumps."""

PAIR_BEAMS, PAIR_OVERLAP, PAIR_INCIDENCE = 20, 0.8, 0.5
"""Of a face that only two scans tell of: beams in each, share of the longer piece before beams of the other, sine of
incidence. Two scan lines nearly always fit a plane: long ones that end together, seen steeply, may be believed."""

Seed = tuple[list[int], Frame]


def _chain(context: Context, owner: IntArray, middle: int, before: int, after: int) -> list[int] | None:
    """Free pieces of successive scans around `middle`, each the longest neighbour of the one before; None: too few."""
    row = context.pieces.row
    chain = [middle]
    for step, count in ((-1, before), (1, after)):
        at = middle
        for _ in range(count):
            free = [k for k in context.neighbours[at] if row[k] == row[at] + step and owner[k] < 0]
            if not free:
                return None
            at = max(free, key=lambda k: context.beams[k])
            chain.append(at)
    return chain


def _by_size(context: Context) -> IntArray:
    return np.argsort(-context.beams, kind="stable")


def plane_seeds(context: Context, owner: IntArray) -> Iterator[Seed]:
    """Three pieces in a plane."""
    yield from _seeds(context, owner, 1, 1, 3)


def bent_seeds(context: Context, owner: IntArray) -> Iterator[Seed]:
    """Five pieces on a surface of second order."""
    yield from _seeds(context, owner, 2, 2, 6)


def _seeds(context: Context, owner: IntArray, before: int, after: int, size: int) -> Iterator[Seed]:
    """Chains that lie on one polynomial surface, by the size of their middle piece."""
    for middle in _by_size(context):
        if owner[middle] >= 0:
            continue
        chain = _chain(context, owner, int(middle), before, after)
        if chain is None:
            continue
        blocks = context.blocks_of(chain)
        frame = fit_plane_frame(blocks, rough_normal(context, chain))
        if _incidence(frame, blocks) < SEED_INCIDENCE:
            continue
        if joint_excess(context, chain, sums_of(frame, blocks, context.sigma), size) < 0.0:
            yield chain, frame


def cylinder_seeds(context: Context, owner: IntArray) -> Iterator[Seed]:
    """Four or five pieces on a vertical cylinder."""
    for middle in _by_size(context):
        if owner[middle] >= 0 or context.beams[middle] < 8:
            continue
        for before, after in ((2, 2), (1, 2), (2, 1)):
            chain = _chain(context, owner, int(middle), before, after)
            if chain is None:
                continue
            blocks = context.blocks_of(chain)
            frame = fit_cylinder_frame(blocks)
            if frame is not None and joint_excess(context, chain, sums_of(frame, blocks, context.sigma), 3) < 0.0:
                yield chain, frame
                break


def pairs(context: Context, owner: IntArray) -> Iterator[tuple[list[int], PlaneFrame]]:
    """Free pieces of two successive scans that lie in a plane which no third scan sees."""
    start, stop, row = context.pieces.start, context.pieces.stop, context.pieces.row
    for first in np.flatnonzero((owner < 0) & (context.beams >= PAIR_BEAMS) & ~context.pieces.curved).tolist():
        for second in context.neighbours[first]:
            common = min(stop[first], stop[second]) - max(start[first], start[second])
            longer = max(stop[first] - start[first], stop[second] - start[second])
            free = owner[first] < 0 and owner[second] < 0 and row[second] == row[first] + 1
            if not free or context.beams[second] < PAIR_BEAMS or common < PAIR_OVERLAP * longer:
                continue
            pair = [first, second]
            blocks = context.blocks_of(pair)
            frame = fit_plane_frame(blocks, rough_normal(context, pair))
            sums = sums_of(frame, blocks, context.sigma)
            if _incidence(frame, blocks) > PAIR_INCIDENCE and joint_excess(context, pair, sums, 3) < 0.0:
                yield pair, frame


def rough_normal(context: Context, chain: list[int]) -> Array | None:
    """Normal of the plane of a piece's direction and the way from scan to scan; None where these are parallel."""
    order = sorted(chain, key=lambda k: context.pieces.row[k])
    parts = [context.blocks_of([k]) for k in order]
    longest = max(parts, key=lambda b: float(np.linalg.norm(b.points[-1] - b.points[0])))
    along = longest.points[-1] - longest.points[0]
    across = parts[-1].points.mean(axis=0) - parts[0].points.mean(axis=0)
    normal = np.cross(along, across)
    length = np.linalg.norm(normal)
    return normal / length if length > 0.05 * np.linalg.norm(along) * np.linalg.norm(across) else None


def _incidence(frame: PlaneFrame, blocks: Blocks) -> float:
    return float(np.average(np.abs(blocks.directions @ frame.axes[:, 2]), weights=blocks.counts))
