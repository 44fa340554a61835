"""Regions joined while the joint criterion falls: parts of a face behind an obstacle, parts of a curved one."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.blocks import Blocks, thinned
from bsmap_cli.fit.context import PRICE, Context
from bsmap_cli.fit.lowmodels import (
    ENOUGH_BLOCKS,
    ORDERS,
    PlaneFrame,
    SphereFrame,
    Sums,
    chi_squares,
    fit_axis,
    fit_cylinder_frame,
    fit_plane_frame,
    fit_sphere_frame,
    sphere_axes,
    sums_of,
    turned,
)
from bsmap_cli.model import Array

NEAR = 1.5
"""Metres between the boxes of two regions that may be one face."""
FAR = 2.0
"""Times the criterion of two regions apart, beyond which that of both as one need not be known exactly."""
DOME = 50
"""Blocks of a surface that may be a sphere: fewer lie on one by chance."""
VAULT = 200
"""Blocks of a surface that may be a cylinder with any axis: clutter lies on many, and to look for them takes time."""


class _Region(NamedTuple):
    """Pieces as one surface; sums : of its blocks, over its frame."""

    members: tuple[int, ...]
    blocks: Blocks
    frame: PlaneFrame
    sums: Sums
    cost: float
    box: Array
    low: "LowOrder"


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
    sums = sums_of(frame, blocks, context.sigma)
    low = _low_order_cost(blocks, sums, context.sigma)
    return _Region(tuple(members), blocks, frame, sums, low.cost, box, low)


class LowOrder(NamedTuple):
    """Least criterion of a low-order surface; whether that is a cylinder, and its frame where it is not vertical.

    bent : whether a plane would not do.  poor : whether no surface of low order would.
    sphere : where it is one; then the cylinder around it has that frame.
    """

    cost: float
    is_round: bool
    bent: bool
    poor: bool
    axes: Array | None = None
    sphere: SphereFrame | None = None


def low_order_cost(blocks: Blocks, frame: PlaneFrame, sigma: float) -> LowOrder:
    """Least criterion over all orders, and over a vertical cylinder where the plane's polynomials are poor.

    A sphere, and a cylinder with any axis, are tried where all these are: what is nearly flat lies on many.
    """
    return _low_order_cost(blocks, sums_of(frame, blocks, sigma), sigma)


def _low_order_cost(blocks: Blocks, sums: Sums, sigma: float) -> LowOrder:
    costs = _costs(sums, len(np.unique(blocks.row)))
    best = int(np.argmin(costs))
    poor = 2.0 * len(blocks.counts) + 50.0
    found = LowOrder(float(costs[best]), False, best > 0, bool(costs[best] > poor))
    # A plane, or what nearly is one, is no cylinder.
    if best > 0 or costs[0] > poor:
        by_circle = _cost_of_cylinder(blocks, None, sigma)
        if by_circle < found.cost:
            found = LowOrder(by_circle, True, True, by_circle > poor)
    hollow = best > 0 and found.cost > poor and len(blocks.counts) >= DOME
    if hollow and (ball := fit_sphere_frame(_some(blocks))) is not None:
        by_sphere = float(chi_squares(sums_of(ball, blocks, sigma), (4,))[0]) + 5 * PRICE
        if by_sphere < found.cost and (axes := sphere_axes(blocks, ball)) is not None:
            found = LowOrder(by_sphere, True, True, by_sphere > poor, axes, ball)
    if best > 0 and found.cost > poor and len(blocks.counts) >= VAULT and (axes := fit_axis(blocks)) is not None:
        by_circle = _cost_of_cylinder(blocks, axes, sigma) + 2 * PRICE
        if by_circle < found.cost:
            found = LowOrder(by_circle, True, True, by_circle > poor, axes)
    return found


def _costs(sums: Sums, rows: int) -> Array:
    """Criteria of polynomials of the degrees that so many scans allow."""
    sizes = tuple(size for size, least in zip(ORDERS, (1, 5, 8, 12), strict=True) if rows >= least)
    return chi_squares(sums, sizes) + PRICE * np.array(sizes)


def _cost_of_cylinder(blocks: Blocks, axes: Array | None, sigma: float) -> float:
    """Criterion of the cylinder along the third of `axes`, or a vertical one; infinite where there is none."""
    blocks = turned(blocks, axes)
    cylinder = fit_cylinder_frame(_some(blocks))
    return np.inf if cylinder is None else float(chi_squares(sums_of(cylinder, blocks, sigma), (3,))[0]) + 4 * PRICE


def _some(blocks: Blocks) -> Blocks:
    """Blocks enough, evenly taken, to tell about which circle or sphere the equations of all are made linear."""
    return blocks.pick(slice(None, None, -(-len(blocks.counts) // ENOUGH_BLOCKS[1])))


def _joined(context: Context, a: _Region, b: _Region) -> _Region | None:
    """The two as one, if that is worth it."""
    apart = np.maximum(a.box[0], b.box[0]) - np.minimum(a.box[1], b.box[1])
    if np.linalg.norm(np.maximum(apart, 0.0)) > NEAR:
        return None
    if _one_before_the_other(context, a, b):
        return None
    vaulted = a.low.bent and b.low.bent and min(len(a.blocks.counts), len(b.blocks.counts)) >= VAULT // 4
    curved = a.low.is_round or b.low.is_round or vaulted
    if not curved and abs(a.frame.axes[:, 2] @ b.frame.axes[:, 2]) < 0.7 and len(b.members) > 1:
        return None
    height = (b.blocks.points - a.frame.origin) @ a.frame.axes[:, 2]
    lowest = np.min(np.abs(height))
    if not curved and lowest > 0.3:
        return None
    limit = a.cost + b.cost + context.slack * float(b.blocks.counts.sum())
    if not curved and _far_from_one(context, a, b, limit):
        return None
    joint = _region(context, a.members + b.members)
    return joint if joint.cost < limit and _same_side(joint) else None


def _one_before_the_other(context: Context, a: _Region, b: _Region) -> bool:
    """Whether a jump in front of the same beams parts two regions: no smooth surface that they could see goes on there.

    A polynomial or a cylinder can be laid through somebody near by and the wall behind, with nothing between the two.
    """
    members = set(b.members)
    return any(k in members for member in a.members for k in context.parted[member])


def _far_from_one(context: Context, a: _Region, b: _Region, limit: float) -> bool:
    """Whether a flat region would have to give up far too much for another: told over its own frame, at little cost."""
    if a.low.bent or len(a.blocks.counts) < VAULT // 4:
        return False
    rows = len(np.union1d(a.blocks.row, b.blocks.row))
    joint = a.sums.plus(sums_of(a.frame, b.blocks, context.sigma))
    return bool(_costs(joint, rows).min() > FAR * limit)


def _same_side(region: _Region) -> bool:
    """Whether the sensor saw all of a region from one side (the two faces of a thin wall are two).

    A circle or a sphere can be laid through somebody near by, seen from outside, and a wall far behind, from inside.
    """
    if region.low.is_round:
        sine = np.sum(region.blocks.directions * _outwards(region), axis=1)
        weights = region.blocks.counts * np.abs(sine)
    else:
        sine, weights = region.blocks.directions @ region.frame.axes[:, 2], region.blocks.counts
    share = float(np.average(sine > 0.0, weights=weights))
    return min(share, 1.0 - share) < 0.05


def _outwards(region: _Region) -> Array:
    """(n, 3) unit vectors at the blocks of a round region away from its axis, or from the middle of its sphere."""
    low, blocks = region.low, turned(region.blocks, region.low.axes)
    if low.sphere is not None:
        away = region.blocks.points - low.sphere.centre
    else:
        found = fit_cylinder_frame(_some(blocks))
        assert found is not None  # by which it is round
        away = np.column_stack([blocks.points[:, :2] - found.centre, np.zeros(len(blocks.points))])
        away = away if low.axes is None else away @ low.axes.T
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9))
