"""What moved between surveys: walls that one survey saw where another one saw bare floor, or what lies behind them.

Faces that moved by less than surfaces are compared over are told by their offset (association); those here moved by
more, came or went. A survey that did not look there says nothing.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from bsmap_cli.merge.oriented import STEP, Oriented, oriented_samples
from bsmap_cli.merge.registration import Target, pairs_of, target
from bsmap_cli.model import Array, BSplineSurface, Decision, SurfaceMap

CLEAR, BEHIND = 0.03, 0.5
"""Metres between which a surface lies behind another one that would have hidden it."""
SHARE, LEAST_AREA = 0.5, 0.1
"""Of a face that must be seen through, and square metres of it."""
MOVED = "moved"
"""Outcome of a decision on what is not the same in two surveys."""


def find_changes(
    groups: Sequence[Sequence[BSplineSurface]],
    surfaces: Sequence[BSplineSurface],
    survey: Mapping[str, int],
    told: Collection[str],
) -> list[Decision]:
    """A decision of each face that moved, came or went.

    Parameters
    ----------
    groups : surfaces that are one face.  surfaces : all of them.  survey : number of each, by name.
    told : names of surfaces that are known to have moved.
    """
    surveys = sorted(set(survey.values()))
    asked = [
        some
        for some in groups
        if len({survey[s.name] for s in some}) < len(surveys) and not any(s.name in told for s in some)
    ]
    samples = [_walls(some) for some in asked]
    gone: list[list[float]] = [[] for _ in asked]
    for number in surveys if any(len(s.points) for s in samples) else []:
        others = [k for k, some in enumerate(asked) if number not in {survey[s.name] for s in some}]
        seen = _seen([s for s in surfaces if survey[s.name] == number], [samples[k].points for k in others])
        if seen is not None:
            for k in others:
                gone[k].append(_seen_through(seen, samples[k]))
    return [
        _decision(some, walls, max(shares))
        for some, walls, shares in zip(asked, samples, gone, strict=True)
        if shares and max(shares) > SHARE and max(shares) * walls.areas.sum() > LEAST_AREA
    ]


def _walls(surfaces: Sequence[BSplineSurface]) -> Oriented:
    samples = oriented_samples(SurfaceMap(tuple(surfaces), ()))
    return samples.of(samples.steep)


def _seen(surfaces: Sequence[BSplineSurface], places: Sequence[Array]) -> Target | None:
    """What surfaces show near places, each (n, 3)."""
    boxes = np.array([[p.min(axis=0), p.max(axis=0)] for p in places if len(p)]).reshape(-1, 2, 3)
    near = []
    for surface in surfaces:
        P = surface.control_points.reshape(-1, 3)
        apart = (boxes[:, 0] > P.max(axis=0) + BEHIND) | (boxes[:, 1] < P.min(axis=0) - BEHIND)
        # A floor lies under all that stands on it.
        if np.any(~apart[:, :2].any(axis=1)):
            near.append(surface)
    samples = oriented_samples(SurfaceMap(tuple(near), ()))
    return target(samples) if len(samples.points) else None


def _seen_through(seen: Target, walls: Oriented) -> float:
    """Share of a face's walls that a survey saw through."""
    if not len(walls.points):
        return 0.0
    pairs = pairs_of(seen, walls, BEHIND)
    before = pairs.aside < 1.5 * STEP
    behind, there = np.zeros((2, len(walls.points)), dtype=bool)
    behind[pairs.numbers] = before & (pairs.offsets > CLEAR)
    there[pairs.numbers] = before & (np.abs(pairs.offsets) < CLEAR)
    through = ~there & (behind | seen.bare.under(walls.points))
    return float(walls.areas[through].sum() / walls.areas.sum())


def _decision(some: Sequence[BSplineSurface], walls: Oriented, share: float) -> Decision:
    largest = max(some, key=lambda surface: (surface.residuals.points, surface.name))
    reason = "it moved, came or went: another survey saw the bare floor there, or what lies behind"
    figures = {"area": float(walls.areas.sum()), "share": share}
    return Decision(largest.name, "", MOVED, reason, {key: float(f"{value:.2g}") for key, value in figures.items()})
