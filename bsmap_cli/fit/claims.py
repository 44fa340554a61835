"""Scan lines that lie on a plane known elsewhere, given to it.

Few scan lines lie on one surface by chance: the last one on a pillar and the first one on the wall behind it have a
plane in common, and with another one of the pillar a cylinder. Where a plane that other scans tell of explains one of
them, such a surface is not needed, and it would bridge the jump.
"""

from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.context import PRICE, Context
from bsmap_cli.fit.lowmodels import ORDERS, PlaneFrame, Sums, chi_squares, fit_plane_frame, sums_of
from bsmap_cli.fit.seeds import PAIR_BEAMS, SEED_INCIDENCE, pairs
from bsmap_cli.model import Array, IntArray

FEWEST_SCANS = 3
"""Of a plane that may claim scan lines, and of what is left of a region."""
FEW_SCANS = 5
"""A region of no more scans may lie on its surface by chance."""
ALIKE = np.radians(2.0)
"""Between the normals of planes that lie alike; from a right angle, those of planes that are square to each other."""

FAR = 0.5
"""Metres from a plane at which it explains nothing, however far it is continued."""


class _Plane(NamedTuple):
    """A flat region over its frame, and its chi square."""

    frame: PlaneFrame
    sums: Sums
    chi: float


def claim(context: Context, regions: list[list[int]], owner: IntArray) -> list[list[int]]:
    """Regions after planes have taken what they explain: long free pieces, and the ends of others of few scans.

    A region that is explained as a whole is left to be joined. What has less than three scans left is given up.
    owner : (k,) region of each piece, -1 for none; changed in place.
    """
    regions = [list(members) for members in regions]
    scans = [_scans(context, members) for members in regions]
    for number in sorted(range(len(regions)), key=lambda k: -scans[k]):
        if scans[number] < FEWEST_SCANS:
            continue
        doubtful = _doubtful(context, regions, scans, owner, number)
        plane = _plane(context, regions[number], scans[number]) if doubtful else None
        claimed = [k for k in doubtful if plane is not None and _explains(context, plane, k)]
        for other in sorted({int(owner[k]) for k in claimed}):
            taken = [k for k in claimed if owner[k] == other]
            if other >= 0:
                left = [k for k in regions[other] if k not in taken]
                if not left:
                    continue
                regions[other], scans[other] = left, _scans(context, left)
            owner[taken] = number
            regions[number] += taken
            if other >= 0 and scans[other] < FEWEST_SCANS:
                owner[regions[other]], regions[other], scans[other] = -1, [], 0
    kept = [members for members in regions if members]
    for number, members in enumerate(kept):
        owner[members] = number
    return kept


def join_pairs(context: Context, regions: list[list[int]], owner: IntArray) -> list[list[int]]:
    """Regions and those pairs of pieces whose plane lies like planes of many scans, or square to two of these.

    A plane that bridges a jump hardly ever lies like that.
    """
    out, directions = list(regions), None
    for pair, frame in pairs(context, owner):
        directions = directions_of(context, regions) if directions is None else directions
        if np.abs(directions @ frame.axes[:, 2]).max(initial=0.0) > np.cos(ALIKE):
            owner[pair] = len(out)
            out.append(pair)
    return out


def directions_of(context: Context, regions: list[list[int]]) -> Array:
    """(k, 3) unit normals of the planes of many scans, and what is square to two that are square to each other."""
    scans = [_scans(context, members) for members in regions]
    sure = [_plane(context, regions[k], scans[k]) for k in range(len(regions)) if scans[k] > FEW_SCANS]
    normals = np.array([plane.frame.axes[:, 2] for plane in sure if plane is not None]).reshape(-1, 3)
    a, b = np.nonzero(np.triu(np.abs(normals @ normals.T) < np.sin(ALIKE), 1))
    across = np.cross(normals[a], normals[b])
    return np.concatenate([normals, across / np.linalg.norm(across, axis=1, keepdims=True)])


def _scans(context: Context, members: list[int]) -> int:
    return len(np.unique(context.pieces.row[members]))


def _doubtful(context: Context, regions: list[list[int]], scans: list[int], owner: IntArray, number: int) -> list[int]:
    """Pieces that a region may be asked to explain: long free ones, those in the end scans of others of few scans."""
    out = np.flatnonzero((owner < 0) & (context.beams >= PAIR_BEAMS)).tolist()
    for other, members in enumerate(regions):
        if other != number and 0 < scans[other] <= FEW_SCANS:
            row = context.pieces.row[members]
            out += np.array(members)[(row == row.min()) | (row == row.max())].tolist()
    return out


def _plane(context: Context, members: list[int], scans: int) -> _Plane | None:
    """A region as a plane; None where another surface would do better, or where a plane does not do."""
    blocks = context.blocks_of(members)
    frame = fit_plane_frame(blocks)
    sums = sums_of(frame, blocks, context.sigma)
    sizes = [size for size, least in zip(ORDERS, (1, 5, 8, 12), strict=True) if scans >= least]
    chi = chi_squares(sums, sizes)
    flat = np.argmin(chi + PRICE * np.array(sizes)) == 0 and chi[0] < 2.0 * len(blocks.counts) + 50.0
    return _Plane(frame, sums, float(chi[0])) if flat else None


def _explains(context: Context, plane: _Plane, piece: int) -> bool:
    """Whether a plane explains a piece at less than the piece's own price, and is not grazed there."""
    blocks = context.blocks_of([piece])
    # Most are far off: no need to ask how sure the plane is there.
    if abs((blocks.points[0] - plane.frame.origin) @ plane.frame.axes[:, 2]) > FAR:
        return False
    if np.abs(blocks.directions @ plane.frame.axes[:, 2]).mean() < SEED_INCIDENCE:
        return False
    joint = plane.sums.plus(sums_of(plane.frame, blocks, context.sigma))
    growth = float(chi_squares(joint, (ORDERS[0],))[0]) - plane.chi
    return growth < context.chi[piece] + context.price[piece] + context.slack * float(context.beams[piece])
