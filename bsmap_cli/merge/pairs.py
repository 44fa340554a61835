"""One pair of patches: is there an overlap to merge, and what comes of it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from bsmap_cli.merge.covariance import share_pose
from bsmap_cli.merge.fusion import Agreement, Fused, Pairing, agreement, fuse, pair_samples
from bsmap_cli.merge.overlap import (
    PRICE_KEPT,
    PRICE_REPLACED,
    land_parameters,
    outline,
    rectangle,
    snap,
    touches,
)
from bsmap_cli.merge.patch import WHOLE, Patch, Window, cut, make_patch, surroundings, width
from bsmap_cli.merge.refit import Refit, refit
from bsmap_cli.model import Decision
from bsmap_cli.params import MergeParams

LEAST_SIDE = 3.0
"""Shortest side of a rectangle that is merged, in units of MergeParams.distance."""
LEAST_SHARE = 0.25
"""Least share of an overlap that its rectangle must hold; below, the overlap has no sensible rectangle."""
LEAST_SAMPLES = 16
"""Fewest samples of a pair whose agreement is worth a test."""
SPOILT = 2.0
"""Times the bounds by which a merged patch may miss its samples (95%) before the merging is taken back."""

GROWTH = 1.0
"""Times the control points of both patches that their pieces may have: merging must not make the map larger."""

Naming = Callable[[str], str]
"""Gives a new name to a piece of the surface of that name."""


class Overlap(NamedTuple):
    """Rectangles of two patches that show the same place: `kept` gives the shape, `replaced` is folded into it.

    area : square metres that the replaced patch loses.  share : of the overlap in it.
    """

    kept: Patch
    replaced: Patch
    kept_window: Window
    replaced_window: Window
    area: float
    share: float


class Merging(NamedTuple):
    """What became of a pair: the patches in the place of the two (None: they stay), and the decision."""

    patches: list[Patch] | None
    decision: Decision


def find_overlap(first: Patch, second: Patch, params: MergeParams) -> Overlap | Decision | None:
    """Overlap of two patches; a refusal where they meet without one to merge; None where they do not meet."""
    a, b = first.surface, second.surface
    if a.data_sets == b.data_sets or not touches(first, second, params.distance):
        return None
    found = outline(first, second, params.distance)
    if found.first is None or found.second is None:
        figures = {"opposite": float(found.opposite)}
        return _refused(a.name, b.name, "they face opposite ways", figures) if found.opposite else None
    options = [
        _overlap(first, second, found.first, found.second, params.distance),
        _overlap(second, first, found.second, found.first, params.distance),
    ]
    best = max((option for option in options if option), key=lambda option: option.area, default=None)
    if best is None or best.area < params.distance**2:
        return None  # neighbours
    if best.share < LEAST_SHARE or not _wide(best, params.distance):
        figures = {"area": best.area, "share": best.share}
        return _refused(a.name, b.name, "no sensible rectangle holds their overlap", figures)
    return best


def _overlap(
    kept: Patch, replaced: Patch, kept_window: Window, replaced_window: Window, distance: float
) -> Overlap | None:
    """Rectangles of an overlap, by the windows around it; None where no cell lies in both patches."""
    lost = rectangle(replaced, replaced_window, kept, distance, PRICE_REPLACED)
    if lost is None:
        return None
    target = cut_like(replaced, snap(replaced, lost.window, distance / 2))
    held = rectangle(kept, kept_window, target, distance, PRICE_KEPT)
    if held is None:
        return None
    kept_window = snap(kept, held.window, LEAST_SIDE * distance)
    return Overlap(kept, replaced, kept_window, snap(replaced, lost.window, distance / 2), lost.area, lost.share)


def cut_like(patch: Patch, window: Window) -> Patch:
    """Part of a patch under its own name; the patch itself for the whole window."""
    return patch if window == WHOLE else cut(patch, window, patch.surface.name)


def _wide(overlap: Overlap, distance: float) -> bool:
    sides = [
        width(patch, axis, *window[2 * axis : 2 * axis + 2])
        for patch, window in ((overlap.kept, overlap.kept_window), (overlap.replaced, overlap.replaced_window))
        for axis in (0, 1)
    ]
    return min(sides) >= LEAST_SIDE * distance


def merge_pair(overlap: Overlap, params: MergeParams, naming: Naming) -> Merging:
    """Divide two patches at their overlap, fuse the pair of pieces that show it, and fit one surface to them."""
    kept, replaced = overlap.kept, overlap.replaced
    names = kept.surface.name, replaced.surface.name
    first, second = cut_like(kept, overlap.kept_window), cut_like(replaced, overlap.replaced_window)
    if not _middle_hits(first, second, params.distance):
        return Merging(
            None, _refused(*names, "the middle of neither overlap lands on the other", {"area": overlap.area})
        )
    pairing = pair_samples(first, second, params.distance)
    figures = {"area": overlap.area, "share": overlap.share, "samples": float(np.count_nonzero(pairing.hit))}
    if len(pairing.offsets) < LEAST_SAMPLES:
        return Merging(None, _refused(*names, "too few samples of one land on the other", figures))
    agreed = agreement(first, second, pairing, params)
    figures |= _figures(agreed, pairing)
    if not agreed.passed:
        return Merging(None, _refused(*names, "they differ by more than their covariances allow", figures))
    fused = fuse(first, second, pairing, params)
    if 2 * fused.moved < len(pairing.offsets):
        return Merging(None, _refused(*names, "most samples differ by more than their covariances allow", figures))
    fitted = refit(first.surface, pairing, fused, params)
    figures |= {"moved": float(fused.moved), "gain": fused.gain, "refit_95": fitted.residuals.percentile_95}
    if fitted.residuals.percentile_95 > SPOILT * max(params.bound_u, params.bound_v):
        return Merging(None, _refused(*names, "the merged patch does not follow its samples", figures))
    merged = _merged_patch(first, second, fused, fitted, naming)
    rests = [*_rests(kept, overlap.kept_window, naming), *_rests(replaced, overlap.replaced_window, naming)]
    before, after = _controls([kept, replaced]), _controls([merged, *rests])
    figures |= {"control_points_before": float(before), "control_points_after": float(after)}
    if after > GROWTH * before:
        return Merging(None, _refused(*names, "the pieces would need more control points than the whole", figures))
    reason = f"they agree; {merged.surface.name} replaces their overlap"
    return Merging([merged, *rests], Decision(*names, "merged", reason, figures))


def _controls(patches: Sequence[Patch]) -> int:
    return sum(int(np.prod(patch.surface.control_points.shape[:2])) for patch in patches)


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


def _merged_patch(first: Patch, second: Patch, fused: Fused, fitted: Refit, naming: Naming) -> Patch:
    root = "+".join(dict.fromkeys([*first.root.split("+"), *second.root.split("+")]))
    pose = share_pose(first.surface.covariance.pose, second.surface.covariance.pose, fused.gain)
    surface = replace(
        first.surface,
        name=naming(root),
        data_sets=tuple(dict.fromkeys([*first.surface.data_sets, *second.surface.data_sets])),
        knots_u=fitted.spline.knots_u,
        knots_v=fitted.spline.knots_v,
        control_points=fitted.spline.control_points,
        covariance=replace(fitted.covariance, pose=pose),
        residuals=fitted.residuals,
    )
    return make_patch(surface, first.facing, root)


def _rests(patch: Patch, window: Window, naming: Naming) -> list[Patch]:
    """Non-overlap pieces of a patch around the window of its overlap."""
    return [cut(patch, rest, naming(patch.root)) for rest in surroundings(patch, window)]


def _refused(first: str, second: str, reason: str, figures: dict[str, float]) -> Decision:
    return Decision(first, second, "refused", reason, figures)
