"""Merging a pair of patches: division at their overlap, test of the pieces that show it, fusion and refit."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bsmap_cli.core.knots import inner_knots
from bsmap_cli.merge.covariance import share_pose
from bsmap_cli.merge.fusion import Agreement, Fused, Pairing, agreement, fuse, pair_samples
from bsmap_cli.merge.overlap import PRICE_KEPT, land_parameters, rectangle, snap
from bsmap_cli.merge.pairs import LEAST_SIDE, Overlap, Side, refused
from bsmap_cli.merge.patch import WHOLE, Patch, Window, cut, make_patch, surroundings, width
from bsmap_cli.merge.refit import Refit, refit
from bsmap_cli.model import Decision
from bsmap_cli.params import MergeParams

LEAST_SAMPLES = 16
"""Fewest samples of a pair whose agreement is worth a test."""
SPOILT = 2.0
"""Times the bounds by which a merged patch may miss its samples (95%) before the merging is taken back."""
GROWTH = 1.15
"""Times the control points of both patches that their pieces may have. Every cut adds some: without a limit the map of
a room falls into hundreds of pieces with three times the control points, with 1.0 most overlaps stay doubled."""

Naming = Callable[[str], str]
"""Gives a new name to a piece of the surface of that name."""


class Plan(NamedTuple):
    """Division of a pair: `kept` gives the shape in its window, `replaced` is folded into it in its own.

    rests : control points of the pieces around both windows.
    """

    kept: Patch
    replaced: Patch
    kept_window: Window
    replaced_window: Window
    rests: int


class Merging(NamedTuple):
    """What became of a pair: the patches in the place of the two (None: they stay), and the decision."""

    patches: list[Patch] | None
    decision: Decision


class _Refusal(Exception):
    """Why a pair stays apart."""


def merge_pair(overlap: Overlap, params: MergeParams, naming: Naming) -> Merging:
    """Divide two patches at their overlap, fuse the pair of pieces that show it, and fit one surface to them."""
    first, second = overlap.first.patch.surface.name, overlap.second.patch.surface.name
    figures = {"area": overlap.area}
    try:
        plan = _best_plan(overlap, params, figures)
        kept, replaced = _part(plan.kept, plan.kept_window), _part(plan.replaced, plan.replaced_window)
        fused, fitted = _fuse_pieces(kept, replaced, params, figures)
        _limit_growth(plan, fitted.spline.control_points.shape[0] * fitted.spline.control_points.shape[1], figures)
    except _Refusal as refusal:
        return Merging(None, refused(first, second, str(refusal), figures))
    merged = _merged_patch(kept, replaced, fused, fitted, naming)
    rests = [*_rests(plan.kept, plan.kept_window, naming), *_rests(plan.replaced, plan.replaced_window, naming)]
    reason = f"they agree; {merged.surface.name} replaces their overlap"
    return Merging([merged, *rests], Decision(first, second, "merged", reason, figures))


def _best_plan(overlap: Overlap, params: MergeParams, figures: dict[str, float]) -> Plan:
    """Of both ways to divide a pair, the one that leaves the fewest control points around the overlap."""
    sides = ((overlap.first, overlap.second), (overlap.second, overlap.first))
    plans = [_plan(kept, replaced, params.distance) for kept, replaced in sides if replaced.inside]
    plan = min((plan for plan in plans if plan), key=lambda plan: plan.rests, default=None)
    if plan is None:
        raise _Refusal("no sensible rectangle holds their overlap")
    _limit_growth(plan, 0, figures)
    return plan


def _limit_growth(plan: Plan, merged: int, figures: dict[str, float]) -> None:
    """Refuse a merging whose pieces, with the merged one's control points, are too many."""
    before, after = _controls(plan.kept, WHOLE) + _controls(plan.replaced, WHOLE), plan.rests + merged
    figures |= {"control_points_before": float(before), "control_points_after": float(after)}
    if after > GROWTH * before:
        raise _Refusal("the pieces would need too many control points")


def _fuse_pieces(kept: Patch, replaced: Patch, params: MergeParams, figures: dict[str, float]) -> tuple[Fused, Refit]:
    """Test whether two pieces pair and agree, fuse their samples, and fit them."""
    if not _middle_hits(kept, replaced, params.distance):
        raise _Refusal("the middle of neither piece lands on the other")
    pairing = pair_samples(kept, replaced, params.distance)
    figures["samples"] = float(np.count_nonzero(pairing.hit))
    if len(pairing.offsets) < LEAST_SAMPLES:
        raise _Refusal("too few samples of one land on the other")
    agreed = agreement(kept, replaced, pairing, params)
    figures |= _figures(agreed, pairing)
    if not agreed.passed:
        raise _Refusal("they differ by more than their covariances allow")
    fused = fuse(kept, replaced, pairing, params)
    if 2 * fused.moved < len(pairing.offsets):
        raise _Refusal("most samples differ by more than their covariances allow")
    fitted = refit(kept.surface, pairing, fused, params)
    figures |= {"moved": float(fused.moved), "gain": fused.gain, "refit_95": fitted.residuals.percentile_95}
    if fitted.residuals.percentile_95 > SPOILT * max(params.bound_u, params.bound_v):
        raise _Refusal("the merged patch does not follow its samples")
    return fused, fitted


def _plan(kept: Side, replaced: Side, distance: float) -> Plan | None:
    """Windows of the division; None where the kept patch has no rectangle of sensible size."""
    assert replaced.inside is not None
    replaced_window = snap(replaced.patch, replaced.inside.window, distance / 2)
    target = _part(replaced.patch, replaced_window)
    held = rectangle(kept.patch, kept.outline, target, distance, PRICE_KEPT)
    least = LEAST_SIDE * distance
    if held is None:
        return None
    kept_window = snap(kept.patch, held.window, least)
    u0, u1, v0, v1 = kept_window
    sides = width(kept.patch, 0, u0, u1), width(kept.patch, 1, v0, v1)
    if min(sides) < least:
        return None
    rests = sum(
        _controls(patch, rest)
        for patch, window in ((kept.patch, kept_window), (replaced.patch, replaced_window))
        for rest in surroundings(patch, window)
    )
    return Plan(kept.patch, replaced.patch, kept_window, replaced_window, rests)


def _controls(patch: Patch, window: Window) -> int:
    """Control points of the part of a patch over a window."""
    surface = patch.surface
    u, v = inner_knots(surface.knots_u, surface.degree_u), inner_knots(surface.knots_v, surface.degree_v)
    along_u = surface.degree_u + 1 + np.count_nonzero((u > window.u0) & (u < window.u1))
    along_v = surface.degree_v + 1 + np.count_nonzero((v > window.v0) & (v < window.v1))
    return int(along_u * along_v)


def _part(patch: Patch, window: Window) -> Patch:
    """Part of a patch under its own name; the patch itself for the whole window."""
    return patch if window == WHOLE else cut(patch, window, patch.surface.name)


def _figures(agreed: Agreement, pairing: Pairing) -> dict[str, float]:
    return {
        "mean_distance": float(np.abs(pairing.offsets).mean()),
        "mahalanobis": float(np.sqrt(agreed.squared_distance / agreed.dof)),
        **{name: float(value) for name, value in agreed._asdict().items()},
    }


def _middle_hits(first: Patch, second: Patch, distance: float) -> bool:
    """Whether the middle point of a patch lands on the other, or the other's on it: the paper's test of a pair."""
    middle = np.array([0.5])
    return any(
        bool(land_parameters(a, middle, middle, b, distance).hit[0]) for a, b in ((first, second), (second, first))
    )


def _merged_patch(kept: Patch, replaced: Patch, fused: Fused, fitted: Refit, naming: Naming) -> Patch:
    root = "+".join(dict.fromkeys([*kept.root.split("+"), *replaced.root.split("+")]))
    pose = share_pose(kept.surface.covariance.pose, replaced.surface.covariance.pose, fused.gain)
    surface = replace(
        kept.surface,
        name=naming(root),
        data_sets=tuple(dict.fromkeys([*kept.surface.data_sets, *replaced.surface.data_sets])),
        knots_u=fitted.spline.knots_u,
        knots_v=fitted.spline.knots_v,
        control_points=fitted.spline.control_points,
        covariance=replace(fitted.covariance, pose=pose),
        residuals=fitted.residuals,
    )
    return make_patch(surface, kept.facing, root)


def _rests(patch: Patch, window: Window, naming: Naming) -> list[Patch]:
    """Non-overlap pieces of a patch around the window of its overlap."""
    return [cut(patch, rest, naming(patch.root)) for rest in surroundings(patch, window)]
