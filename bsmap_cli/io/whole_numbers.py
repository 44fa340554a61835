"""Numbers of an artifact as whole ones, in units of what they are worth: few digits, for the bytes of a map matter.

Where neighbours are alike, each is written as its difference to the one before.
"""

from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from bsmap_cli.core.gaussian import rounded_root, symmetric_sqrt
from bsmap_cli.model import Array, Decision

POINTS, CURVES, DIRECTIONS, WEIGHTS = 1e5, 1e4, 1e5, 1e4
"""Units in a metre, of control points and of creases and corners; in 1, of directions, and of weights of poses."""
POSES = np.array([1e5, 1e5, 1e6])
"""Units in a metre, a metre and a radian, of errors of pose (x, y, theta)."""
MOST_ROUNDS = 20
"""In which the rounded root of a singular covariance settles."""
ROOTS = 1e8
"""Units in a metre of roots of heights' covariances, before they are scaled."""
LEAST_ROOT = 100.0
"""Units that the diagonal of a root has at least, so that rounding changes no variance by more than a percent."""


def whole(values: ArrayLike, units: float | Array, axes: Sequence[int] = ()) -> Any:
    """Nested lists of whole numbers of units; along axes the first one, and differences.

    Raises
    ------
    ValueError
        A number is not finite.
    """
    numbers = np.rint(np.asarray(values, dtype=float) * units)
    if not np.isfinite(numbers).all():
        raise ValueError("a number that is not finite is not JSON compliant")
    for axis in axes:
        numbers = np.diff(numbers, axis=axis, prepend=np.zeros_like(numbers.take([0] if numbers.size else [], axis)))
    return numbers.astype(np.int64).tolist()


def from_whole(numbers: Array, units: float | Array, axes: Sequence[int] = ()) -> Array:
    """The values that `whole` gave as numbers."""
    for axis in axes:
        numbers = numbers.cumsum(axis=axis)
    return np.asarray(numbers / units)


def scaled_root(covariance: Array) -> tuple[int, Array] | None:
    """Root (n, n) of a covariance in whole multiples of a power of two of units, and that power; None where it is
    nearly singular.

    The power is the largest for which the least number on the diagonal is LEAST_ROOT or more.
    """
    scale, root = 1, rounded_root(covariance, 1.0 / ROOTS, LEAST_ROOT)
    found = None if root is None else (scale, root)
    while found is not None and np.diag(found[1]).min() >= 2.0 * LEAST_ROOT:
        scale *= 2
        coarser = rounded_root(covariance, scale / ROOTS, LEAST_ROOT)
        if coarser is None:
            break
        found = scale, coarser
    return found


def pose_root(own: Array) -> list[int]:
    """Upper triangle, row by row, of the symmetric root of a covariance (3, 3) of errors of pose.

    It is rounded until it is the root of its own square.
    """
    root = np.rint(symmetric_sqrt(own * np.outer(POSES, POSES)))
    for _ in range(MOST_ROUNDS):
        again = np.rint(symmetric_sqrt(root @ root))
        if np.array_equal(again, root):
            break
        root = again
    return [int(value) for value in root[np.triu_indices(3)]]


def from_pose_root(numbers: Array) -> Array:
    """The covariance (3, 3) that `pose_root` gave as numbers (6,)."""
    root = np.zeros((3, 3))
    root[np.triu_indices(3)] = numbers
    root += np.triu(root, 1).T
    return np.asarray(root @ root / np.outer(POSES, POSES))


def runs_of(decisions: Iterable[Decision]) -> list[dict[str, Any]]:
    """Decisions that follow each other with the same outcome, reason and names of figures, put together."""
    runs = groupby(decisions, key=lambda d: (d.outcome, d.reason, tuple(d.figures)))
    return [
        {
            "outcome": outcome,
            "reason": reason,
            "figures": list(names),
            "pairs": [[d.first, d.second, *d.figures.values()] for d in some],
        }
        for (outcome, reason, names), some in runs
    ]
