"""Regions of pieces that lie on one smooth surface, grown over neighbouring scans, then merged.

After Jiang and Bunke (1994, "Fast segmentation of range images into planar regions by scan line grouping") with
surfaces of higher order and a statistical criterion: a piece joins where that raises chi square by less than its own
parameters are worth.
"""

import functools
import itertools
from collections import deque

import numpy as np

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.claims import claim, join_pairs
from bsmap_cli.fit.context import PRICE, Context, make_context
from bsmap_cli.fit.grazing import GRAZED, STEEPER
from bsmap_cli.fit.lowmodels import (
    ORDERS,
    Frame,
    PlaneFrame,
    Sums,
    chi_squares,
    fit_plane_frame,
    sums_of,
    sums_of_rows,
    weighted_rows,
)
from bsmap_cli.fit.pieces import Pieces
from bsmap_cli.fit.seeds import bent_seeds, cylinder_seeds, plane_seeds, rough_normal
from bsmap_cli.fit.unions import unite_regions
from bsmap_cli.model import IntArray


def find_regions(grid: BeamGrid, pieces: Pieces) -> tuple[list[list[int]], float]:
    """Numbers of the pieces of each region, largest region first; pieces of no region are left out.

    Also the noise along the beam that block means show, metres: that of single beams, or more where it is not white.
    """
    context = make_context(grid, pieces)
    owner = np.full(len(pieces.row), -1)
    regions: list[list[int]] = []
    for find in (plane_seeds, bent_seeds, cylinder_seeds):
        for seed, frame in find(context, owner):
            if np.any(owner[seed] >= 0):
                continue
            grown = _grow(context, owner, seed, frame)
            owner[grown] = len(regions)
            regions.append(grown)
    regions = join_pairs(context, claim(context, regions, owner), owner)
    return unite_regions(context, without_grazed_scans(context, regions, owner)), context.sigma


def _sizes(frame: Frame, rows: int) -> tuple[int, ...]:
    """Orders allowed for a region over a number of scans: the data must be able to contradict it across the scans."""
    if not isinstance(frame, PlaneFrame):
        return (3,)
    return tuple(size for size, least in zip(ORDERS, (1, 5, 8, 12), strict=True) if rows >= least)[:3]


def _cost(sums: Sums, frame: Frame, rows: int) -> float:
    """Least criterion over the orders allowed."""
    sizes = _sizes(frame, rows)
    return float(np.min(chi_squares(sums, sizes) + PRICE * np.array(sizes)))


def _grow(context: Context, owner: IntArray, seed: list[int], frame: Frame) -> list[int]:
    """Pieces that the seed's surface reaches, scan by scan, its order rising as the data ask for it."""
    N, data = weighted_rows(frame, context.blocks, context.sigma)
    N = N[:, : _sizes(frame, len(N))[-1]]
    spans = [slice(*ends) for ends in itertools.pairwise(context.first.tolist())]
    sums = functools.reduce(Sums.plus, [sums_of_rows(N[spans[k]], data[spans[k]]) for k in seed])
    row = context.pieces.row.tolist()
    members, rows, taken = list(seed), {row[k] for k in seed}, set(seed)
    cost = _cost(sums, frame, len(rows))
    waiting = deque(k for member in seed for k in context.neighbours[member])
    tries: dict[int, int] = {}
    while waiting:
        k = waiting.popleft()
        if k in taken or owner[k] >= 0 or tries.get(k, 0) > 3:
            continue
        tries[k] = tries.get(k, 0) + 1
        more = sums.plus(sums_of_rows(N[spans[k]], data[spans[k]]))
        joint = _cost(more, frame, len(rows | {row[k]}))
        if joint < cost + context.chi[k] + context.price[k] + context.slack * context.beams[k]:
            members.append(k)
            taken.add(k)
            rows.add(row[k])
            sums, cost = more, joint
            waiting.extend(context.neighbours[k])
    return members


def without_grazed_scans(context: Context, regions: list[list[int]], owner: IntArray) -> list[list[int]]:
    """Regions without the pieces at their ends that they only graze and that the next scan's region explains.

    A scan in the plane that touches a pillar's side lies on the pillar and on the wall behind it; with the pillar's
    parts it lies on no cylinder. owner : (k,) region of each piece, -1 for none; changed in place.
    """
    regions = [list(members) for members in regions]
    for members in regions:
        for step in (-1, 1):
            for piece, inner in _ends(context, members, step):
                normal = rough_normal(context, [piece, inner])
                if normal is None or np.abs(context.blocks_of([piece]).directions @ normal).mean() > GRAZED:
                    continue
                other = _next_region(context, owner, piece, step)
                if other is not None and _explains(context, regions[other], piece):
                    members.remove(piece)
                    regions[other].append(piece)
                    owner[piece] = other
    return [members for members in regions if members]


def _ends(context: Context, members: list[int], step: int) -> list[tuple[int, int]]:
    """Pieces of a region in its last scan in a direction, each with its longest neighbour in the scan before."""
    row = context.pieces.row
    last = max((int(row[k]) * step for k in members), default=0) * step
    out = []
    for piece in [k for k in members if row[k] == last]:
        inner = [k for k in context.neighbours[piece] if row[k] == last - step and k in members]
        if inner:
            out.append((piece, max(inner, key=lambda k: float(context.beams[k]))))
    return out


def _next_region(context: Context, owner: IntArray, piece: int, step: int) -> int | None:
    """Region of the longest piece beside another one in the next scan; None where that is the same or none."""
    row = context.pieces.row
    beyond = [k for k in context.neighbours[piece] if row[k] == row[piece] + step]
    if not beyond:
        return None
    found = int(owner[max(beyond, key=lambda k: float(context.beams[k]))])
    return found if found >= 0 and found != owner[piece] else None


def _explains(context: Context, members: list[int], piece: int) -> bool:
    """Whether a region meets a piece steeply and explains it at less than the piece's own price."""
    blocks, more = context.blocks_of(members), context.blocks_of([piece])
    frame = fit_plane_frame(blocks)
    if np.abs(more.directions @ frame.axes[:, 2]).mean() < STEEPER * GRAZED:
        return False
    rows = len(set(context.pieces.row[members].tolist()))
    sums = sums_of(frame, blocks, context.sigma)
    growth = _cost(sums.plus(sums_of(frame, more, context.sigma)), frame, rows) - _cost(sums, frame, rows)
    return bool(growth < context.chi[piece] + context.price[piece] + context.slack * context.beams[piece])
