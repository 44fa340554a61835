"""Which pairs of patches overlap, and in which rectangle of each."""

from typing import NamedTuple

from bsmap_cli.merge.overlap import PRICE_REPLACED, Rectangle, outline, rectangle, touches
from bsmap_cli.merge.patch import Patch, Window, width
from bsmap_cli.model import Decision
from bsmap_cli.params import MergeParams

LEAST_SIDE = 6.0
"""Shortest side of a rectangle that is merged, in units of MergeParams.distance."""
LEAST_SHARE = 0.25
"""Least share of an overlap that its rectangle must hold; below, the overlap has no sensible rectangle."""


class Side(NamedTuple):
    """One patch of an overlapping pair.

    outline : window around the overlap.  inside : the largest rectangle inside; None where there is no sensible one.
    """

    patch: Patch
    outline: Window
    inside: Rectangle | None


class Overlap(NamedTuple):
    """Two patches that show the same place, and the area in square metres of the larger rectangle inside."""

    first: Side
    second: Side
    area: float


def find_overlap(first: Patch, second: Patch, params: MergeParams) -> Overlap | Decision | None:
    """Overlap of two patches; a refusal where they meet without one to merge; None where they do not meet."""
    a, b = first.surface, second.surface
    least = LEAST_SIDE * params.distance
    if (
        a.data_sets == b.data_sets
        or min(*first.size, *second.size) < least
        or not touches(first, second, params.distance)
    ):
        return None
    found = outline(first, second, params.distance)
    if found.first is None or found.second is None:
        figures = {"opposite": float(found.opposite)}
        return refused(a.name, b.name, "they face opposite ways", figures) if found.opposite else None
    widths = [_narrower_side(first, found.first), _narrower_side(second, found.second)]
    if max(widths) < params.distance:
        return None  # neighbours
    inside = [
        rectangle(patch, window, other, params.distance, PRICE_REPLACED) if narrow >= least else None
        for patch, window, other, narrow in (
            (first, found.first, second, widths[0]),
            (second, found.second, first, widths[1]),
        )
    ]
    sides = [
        Side(patch, window, found_inside if _sensible(patch, found_inside, least) else None)
        for patch, window, found_inside in zip((first, second), (found.first, found.second), inside, strict=True)
    ]
    area = max((side.inside.area for side in sides if side.inside), default=0.0)
    if area > 0.0:
        return Overlap(sides[0], sides[1], area)
    largest = max((candidate for candidate in inside if candidate), key=lambda r: r.area, default=None)
    figures = {"area": largest.area, "share": largest.share} if largest else {"width": max(widths)}
    return refused(a.name, b.name, "no sensible rectangle holds their overlap", figures)


def _sensible(patch: Patch, inside: Rectangle | None, least: float) -> bool:
    if inside is None or inside.share < LEAST_SHARE:
        return False
    return _narrower_side(patch, inside.window) >= least


def _narrower_side(patch: Patch, window: Window) -> float:
    """Shorter side of a window in metres."""
    u0, u1, v0, v1 = window
    return min(width(patch, 0, u0, u1), width(patch, 1, v0, v1))


def refused(first: str, second: str, reason: str, figures: dict[str, float]) -> Decision:
    """Decision that two surfaces stay apart."""
    return Decision(first, second, "refused", reason, figures)
