"""Maps of different origin brought into one frame, each with the verdict whether its place is the only one."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.core import se2
from bsmap_cli.errors import PlacementError
from bsmap_cli.merge.bare import floor_level
from bsmap_cli.merge.inputs import by_extent
from bsmap_cli.merge.oriented import Oriented, oriented_samples, with_areas
from bsmap_cli.merge.placed import placed
from bsmap_cli.merge.registration import Laid, Target, judged, placement_covariance, refined, target
from bsmap_cli.merge.search import candidates
from bsmap_cli.model import Array, Placement, SurfaceMap
from bsmap_cli.params import MergeParams
from bsmap_cli.track import Track, silent

TRIED = 24
"""Placements that are refined and judged, the best of the search."""
APART = 0.5, np.radians(10.0)
"""Metres and radians from which on two placements are different ones."""
LEAST_MATCHED, LEAST_SHARE = 4.0, 0.1
"""Square metres, and share of the walls of the smaller map, that must speak for a placement: else there is none."""
LEAST_HELD = 0.2
"""Square metres of walls that must hold a map in each direction: a door's jambs have more."""
RIVAL = 0.8
"""Share of the best score from which on the second best placement may be the true one."""


class _Trial(NamedTuple):
    """Best placement and the second best one, if there is one; why the best is not the only one, or none at all."""

    best: Laid | None
    rival: Laid | None
    refusal: str


def bring_together(
    maps: Sequence[SurfaceMap], params: MergeParams, *, track: Track = silent
) -> tuple[list[SurfaceMap], tuple[Placement, ...]]:
    """All maps in the frame of one of them, and how the others were placed.

    The one is a map of joined faces if there is one, else that of most data sets. The others follow one by one, the
    surest first, each compared with all that have their place already.

    Raises
    ------
    PlacementError
        A map does not overlap with the others, could slide along them, or could lie in more than one place.
    """
    order = sorted(range(len(maps)), key=lambda number: by_extent(maps[number]))
    samples = {number: oriented_samples(maps[number]) for number in order}
    if empty := [number for number in order if not len(samples[number].points)]:
        raise PlacementError(empty[0], "it has no surfaces that could tell its place")
    together, done = samples[order[0]], list[Placement]()
    waiting = {number: target(samples[number]) for number in order[1:]}
    while waiting:
        track("placing maps", len(done), len(maps) - 1)
        fixed = target(together)
        trials = {number: _trial(fixed, moving, params) for number, moving in waiting.items()}
        number = max(trials, key=lambda n: (not trials[n].refusal, _score(trials[n].best)))
        if trials[number].refusal or trials[number].best is None:
            raise PlacementError(number, trials[number].refusal)
        done.append(_placement(number, fixed, waiting.pop(number), trials[number], params))
        here = samples[number].moved(done[-1].pose, done[-1].height)
        together = with_areas(*(np.concatenate([a, b]) for a, b in zip(together[:2], here[:2], strict=True)))
    track("placing maps", len(maps) - 1, len(maps) - 1)
    placements = tuple(sorted(done, key=lambda placement: placement.survey))
    return in_one_frame(maps, placements), placements


def in_one_frame(maps: Sequence[SurfaceMap], placements: Sequence[Placement]) -> list[SurfaceMap]:
    """The maps, those that were placed where they belong."""
    by_number = {placement.survey: placement for placement in placements}
    return [placed(m, by_number[k]) if k in by_number else m for k, m in enumerate(maps)]


def _score(laid: Laid | None) -> float:
    return laid.score if laid else 0.0


def _trial(fixed: Target, moving: Target, params: MergeParams) -> _Trial:
    """The best placement that is found anywhere, and what speaks against it."""
    levels = floor_level(fixed.samples), floor_level(moving.samples)
    lifted = [t.samples.moved(np.zeros(3), -level) for t, level in zip((fixed, moving), levels, strict=True)]
    found: list[Laid] = []
    for start in candidates(*lifted)[:TRIED]:
        pose, height = refined(fixed, moving.few, start, levels[0] - levels[1])
        found.append(judged(fixed, moving, pose, height, params.distance))
    found.sort(key=lambda laid: -laid.score)
    if not found:
        return _Trial(None, None, "no placement of it fits the others: they do not overlap")
    best = found[0]
    rival = next((laid for laid in found if _apart(laid.pose, best.pose)), None)
    return _Trial(best, rival, _refusal(best, rival, min(_walls(fixed.samples), _walls(moving.samples))))


def _walls(samples: Oriented) -> float:
    """Square metres."""
    return float(samples.areas[samples.steep].sum())


def _apart(one: Array, other: Array) -> bool:
    x, y, turn = se2.between(one, other)
    return bool(np.hypot(x, y) > APART[0] or abs(turn) > APART[1])


def _refusal(best: Laid, rival: Laid | None, walls: float) -> str:
    """Why a placement is refused; empty where it is not."""
    least = max(LEAST_MATCHED, LEAST_SHARE * walls)
    if best.score < least:
        return (
            f"the best placement scores {best.score:.1f} m2 of walls, wanted {least:.1f}: "
            "they do not overlap, or too little"
        )
    if best.held < LEAST_HELD:
        return (
            f"it could slide or turn along the others: only {best.held:.2f} m2 of walls hold it "
            f"in one direction, wanted {LEAST_HELD}"
        )
    if rival is not None and rival.score > RIVAL * best.score:
        return (
            f"it could lie at {described(best.pose)} or at {described(rival.pose)}: "
            f"the second scores {rival.score / best.score:.0%} of the first, wanted at most {RIVAL:.0%}"
        )
    return ""


def described(pose: Array) -> str:
    """A pose for people."""
    return f"x {pose[0]:.2f} m, y {pose[1]:.2f} m, {np.degrees(pose[2]):.1f} deg"


def _placement(number: int, fixed: Target, moving: Target, trial: _Trial, params: MergeParams) -> Placement:
    """The best placement once more, by all samples."""
    assert trial.best is not None
    pose, height = refined(fixed, moving.samples, trial.best.pose, trial.best.height)
    laid = judged(fixed, moving, pose, height, params.distance)
    return Placement(
        survey=number,
        pose=pose,
        height=height,
        covariance=placement_covariance(fixed, moving.samples, laid, params.distance, params.flatness),
        matched=laid.matched,
        denied=laid.denied,
        rival=max(_score(trial.rival), 0.0) / trial.best.score,
        rival_pose=None if trial.rival is None else trial.rival.pose,
        verdict="unique",
    )
