"""Regions joined while the joint criterion falls: parts of a face behind an obstacle, parts of a curved one."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.blocks import Blocks, thinned
from bsmap_cli.fit.context import PRICE, Context
from bsmap_cli.fit.lowmodels import (
    ORDERS,
    PlaneFrame,
    chi_squares,
    fit_cylinder_frame,
    fit_plane_frame,
    sums_of,
)
from bsmap_cli.model import Array

NEAR = 1.5
"""Metres between the boxes of two regions that may be one face."""


class _Region(NamedTuple):
    members: tuple[int, ...]
    blocks: Blocks
    frame: PlaneFrame
    cost: float
    box: Array
    round: bool


def unite_regions(context: Context, regions: list[list[int]]) -> list[list[int]]:
    """Join regions while the joint criterion falls: parts of a face behind an obstacle, parts of a curved one."""
    found = [_region(context, members) for members in regions]
    found.sort(key=lambda r: -float(r.blocks.counts.sum()))
    apart: set[tuple[tuple[int, ...], tuple[int, ...]]] = set()
    k = 0
    while k < len(found):
        for other in range(len(found) - 1, k, -1):
            pair = found[k].members, found[other].members
            joint = _joined(context, found[k], found[other]) if pair not in apart else None
            if joint is not None:
                found[k] = joint
                del found[other]
                k = -1
                break
            apart.add(pair)
        k += 1
    found.sort(key=lambda r: -float(r.blocks.counts.sum()))
    return [list(region.members) for region in found]


def _region(context: Context, members: Sequence[int]) -> _Region:
    blocks = thinned(context.blocks_of(members))
    frame = fit_plane_frame(blocks)
    box = np.array([blocks.points.min(axis=0), blocks.points.max(axis=0)])
    cost, is_round = low_order_cost(blocks, frame, context.sigma)
    return _Region(tuple(members), blocks, frame, cost, box, is_round)


class LowOrder(NamedTuple):
    """Least criterion of a low-order surface; whether that is a vertical cylinder."""

    cost: float
    is_round: bool


def low_order_cost(blocks: Blocks, frame: PlaneFrame, sigma: float) -> LowOrder:
    """Least criterion over all orders, and over a vertical cylinder where the plane's polynomials are poor."""
    sums = sums_of(frame, blocks, sigma)
    rows = len(np.unique(blocks.row))
    sizes = tuple(size for size, least in zip(ORDERS, (1, 5, 8, 12), strict=True) if rows >= least)
    costs = chi_squares(sums, sizes) + PRICE * np.array(sizes)
    best = int(np.argmin(costs))
    # A plane, or what nearly is one, is no cylinder.
    if best > 0 or costs[0] > 2.0 * len(blocks.counts) + 50.0:
        cylinder = fit_cylinder_frame(blocks)
        if cylinder is not None:
            by_circle = float(chi_squares(sums_of(cylinder, blocks, sigma), (3,))[0]) + 4 * PRICE
            if by_circle < costs[best]:
                return LowOrder(by_circle, True)
    return LowOrder(float(costs[best]), False)


def _joined(context: Context, a: _Region, b: _Region) -> _Region | None:
    """The two as one, if that is worth it."""
    apart = np.maximum(a.box[0], b.box[0]) - np.minimum(a.box[1], b.box[1])
    if np.linalg.norm(np.maximum(apart, 0.0)) > NEAR:
        return None
    if not (a.round or b.round) and abs(a.frame.axes[:, 2] @ b.frame.axes[:, 2]) < 0.7 and len(b.members) > 1:
        return None
    height = (b.blocks.points - a.frame.origin) @ a.frame.axes[:, 2]
    lowest = np.min(np.abs(height))
    if not (a.round or b.round) and lowest > 0.3:
        return None
    joint = _region(context, a.members + b.members)
    if _same_side(joint) and joint.cost < a.cost + b.cost + context.slack * float(b.blocks.counts.sum()):
        return joint
    return None


def _same_side(region: _Region) -> bool:
    """Whether the sensor saw all of a region from one side of its plane (the two faces of a thin wall are two)."""
    if region.round:
        return True
    towards = region.blocks.directions @ region.frame.axes[:, 2]
    share = float(np.average(towards > 0.0, weights=region.blocks.counts))
    return min(share, 1.0 - share) < 0.05
