"""One map laid over another one from a start: point to plane, robust, and how well both agree where it came to lie."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from bsmap_cli.core import se2
from bsmap_cli.merge.bare import Bare, bare_floor
from bsmap_cli.merge.oriented import STEP, Oriented
from bsmap_cli.merge.search import DENIED
from bsmap_cli.model import Array, IntArray

REACHES = (0.5, 0.4, 0.3, 0.2, 0.15, 0.1, 0.1, 0.1)
"""Metres within which samples pair, round by round."""
FEW = 4000
"""Samples by which placements are tried."""
LEVEL_SIGMA = 0.01
"""Metres by which the height of a map is known from its floor, before its level faces are compared."""
BEHIND = 0.5
"""Metres before or behind a wall where no other one can be seen that looks the same way: one would hide the other."""
INDEPENDENT = 1.0
"""Square metres of a wall whose samples err alike, for walls and poses err over their length."""


class Target(NamedTuple):
    """A map that is laid over another one.  few : of its samples, for trials.  tree : of all samples' keys."""

    samples: Oriented
    few: Oriented
    tree: cKDTree
    bare: Bare


class Laid(NamedTuple):
    """pose : (3,), height : metres, of the moving map in the fixed one.

    matched : square metres of walls that lie on walls of the other map.  denied : of those, of both maps, that stand
    where the other one saw bare floor, or close before or behind another wall.  held : square metres of walls that hold
    the map against the shift, or the turn (one radian counting as a metre), that the fewest stand against: of a bare
    corridor none.
    """

    pose: Array
    height: float
    matched: float
    denied: float
    held: float

    @property
    def score(self) -> float:
        """Square metres that speak for the placement less those that speak against it."""
        return self.matched - DENIED * self.denied


def target(samples: Oriented) -> Target:
    """Ready to be looked up."""
    return Target(samples, thinned(samples), cKDTree(samples.keys()), bare_floor(samples))


def thinned(samples: Oriented) -> Oriented:
    """Few samples by chance, always the same, which stand for the areas of all."""
    total = len(samples.points)
    if total <= FEW:
        return samples
    some = samples.of(np.sort(np.random.default_rng(0).choice(total, FEW, replace=False)))
    return some._replace(areas=some.areas * total / FEW)


class Pairs(NamedTuple):
    """Samples of the moving map, moved, that have a partner: their numbers, offsets along its normal and across it, and
    its normal.
    """

    numbers: IntArray
    offsets: Array
    aside: Array
    normals: Array


def pairs_of(fixed: Target, moved: Oriented, reach: float) -> Pairs:
    """Each moved sample with the nearest of the fixed map that looks the same way, less than `reach` metres off it."""
    distance, nearest = map(np.asarray, fixed.tree.query(moved.keys(), distance_upper_bound=reach + STEP))
    numbers = np.flatnonzero(np.isfinite(distance))
    partners = fixed.samples.of(nearest[numbers])
    ways = moved.points[numbers] - partners.points
    offsets = np.sum(ways * partners.normals, axis=1)
    aside = np.linalg.norm(ways - offsets[:, None] * partners.normals, axis=1)
    near = np.abs(offsets) < reach
    return Pairs(numbers[near], offsets[near], aside[near], partners.normals[near])


def refined(fixed: Target, moving: Oriented, pose: Array, height: float) -> tuple[Array, float]:
    """Pose (3,) and height for which the moving map's samples lie nearest to the fixed one's surfaces (Tukey's loss).

    A direction in which nothing holds the map stays as it was at the start.
    """
    floor = height
    for reach in REACHES:
        moved = moving.moved(pose, height)
        pairs = pairs_of(fixed, moved, reach)
        J = _by_pose(moved.points[pairs.numbers], pairs.normals, pose)
        weights = moved.areas[pairs.numbers] * (1.0 - (pairs.offsets / reach) ** 2) ** 2
        H, g = J.T @ (weights[:, None] * J), J.T @ (weights * pairs.offsets)
        prior = weights.sum() * (reach / 3.0 / LEVEL_SIGMA) ** 2
        H[3, 3] += prior
        g[3] += prior * (height - floor)
        step = np.linalg.lstsq(H, g, rcond=1e-6)[0]
        pose, height = pose - step[:3], height - float(step[3])
    return pose * [1.0, 1.0, 0.0] + [0.0, 0.0, float(se2.wrap(pose[2]))], height


def _by_pose(points: Array, normals: Array, pose: Array) -> Array:
    """(n, 4) change of points (n, 3) along normals (n, 3) by x, y, turn about the pose's place, and height."""
    x, y = (points[:, :2] - pose[:2]).T
    return np.column_stack([normals[:, 0], normals[:, 1], normals[:, 1] * x - normals[:, 0] * y, normals[:, 2]])


def judged(fixed: Target, moving: Target, pose: Array, height: float, distance: float) -> Laid:
    """How well both maps agree; samples that lie no farther than `distance` from a surface of the other map match."""
    there, here = moving.few.moved(pose, height), fixed.few.moved(se2.between(pose, np.zeros(3)), -height)
    good, denied = _compared(fixed, there, distance)
    denied += _compared(moving, here, distance)[1]
    weights = (good * there.areas)[there.steep]
    matched = float(weights.sum())
    walls = there.of(there.steep)
    middle = np.append(weights @ walls.points[:, :2] / max(matched, 1e-12), 0.0)
    J = _by_pose(walls.points, walls.normals, middle)[:, :3]
    held = float(np.linalg.eigvalsh(J.T @ (weights[:, None] * J))[0])
    return Laid(pose, height, matched, denied, max(held, 0.0))


def _compared(fixed: Target, moved: Oriented, distance: float) -> tuple[Array, float]:
    """(n,) how well samples match, 1 on a surface of the fixed map, 0 where none is near; and square metres denied."""
    pairs = pairs_of(fixed, moved, BEHIND)
    good = np.zeros(len(moved.points))
    good[pairs.numbers] = np.maximum(1.0 - (pairs.offsets / distance) ** 2, 0.0)
    behind = np.zeros(len(good), dtype=bool)
    behind[pairs.numbers] = pairs.aside < 1.5 * STEP
    denied = moved.steep & (good == 0.0) & (fixed.bare.under(moved.points) | behind)
    return good, float(moved.areas[denied].sum())


def placement_covariance(fixed: Target, moving: Oriented, laid: Laid, distance: float, flatness: float) -> Array:
    """(3, 3) of x, y, turn of a placement: by how far the walls that match are off, INDEPENDENT square metres at once.

    flatness : metres by which walls leave their faces, whatever they are off.
    """
    moved = moving.moved(laid.pose, laid.height)
    walls = moved.of(moved.steep)
    pairs = pairs_of(fixed, walls, distance)
    J = _by_pose(walls.points[pairs.numbers], pairs.normals, laid.pose)[:, :3]
    weights = walls.areas[pairs.numbers]
    variance = weights @ pairs.offsets**2 / weights.sum() + flatness**2
    information = J.T @ (weights[:, None] * J) / (INDEPENDENT * variance)
    return np.asarray(np.linalg.inv(information))
