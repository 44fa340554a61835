"""Trim loops in whole numbers: vertices along creases by how far they are from where the crease tells, others by how
far they are from the vertex before.

A crease that a loop runs along from end to end says where the vertices are, as seen across the plane through the first
control point and those at the ends of its row and column. Over planes that is exact, so that hardly anything is left.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from bsmap_cli.model import Array, IntArray, TrimLoop

RIMS = 1e3
"""Units in a metre of the brackets of rims."""
TRIMS = 2e3
"""Steps in a metre of the parameters of trims, about: so many to the length of the surface."""


class Sheet(NamedTuple):
    """Where a surface lies, about.

    corner : (3,).  to_parameters : (3, 2), from ways off it.  steps : (2,) into which parameters are divided.
    """

    corner: Array
    to_parameters: Array
    steps: Array

    def steps_at(self, points: Array) -> Array:
        """(n, 2) whole steps about at points (n, 3)."""
        uv = np.clip((points - self.corner) @ self.to_parameters, 0.0, 1.0)
        return np.asarray(np.rint(uv * self.steps))


def sheet_of(control_points: Array) -> Sheet:
    """Sheet of control points (nu, nv, 3), as a file has them."""
    P = control_points
    lengths = [np.linalg.norm(np.diff(P, axis=axis), axis=2).sum(axis=axis).max() for axis in (0, 1)]
    steps = np.maximum(np.ceil(np.array(lengths) * TRIMS), 1.0)
    sides = np.column_stack([P[-1, 0] - P[0, 0], P[0, -1] - P[0, 0]])
    return Sheet(P[0, 0], np.linalg.pinv(sides, rcond=1e-6).T, steps)


def pack_loop(loop: TrimLoop, sheet: Sheet, lines: Sequence[Array]) -> tuple[IntArray, IntArray]:
    """Whole numbers (n, 2) and creases (n,) of a loop.

    Parameters
    ----------
    lines : points (k, 3) of each crease, as a file has them.

    Returns
    -------
    Steps that vertices lie off where creases tell, or off the vertex before; and for the side from each vertex to the
    next one 0 for none, else one more than the number of the crease, negative where the loop runs along it backwards.
    """
    steps, creases = np.rint(loop.parameters * sheet.steps), np.asarray(loop.creases) + 1
    for sides in _whole_runs(creases, lines):
        told = sheet.steps_at(lines[creases[sides[0]] - 1][[0, -1]])
        ends = steps[[sides[0], (sides[-1] + 1) % len(steps)]]
        if np.abs(ends - told[::-1]).sum() < np.abs(ends - told).sum():
            creases[sides] *= -1
    told = _told(creases, sheet, lines)
    before = np.concatenate([np.zeros((1, 2)), steps[:-1]])
    return (steps - np.where(np.isnan(told), before, told)).astype(np.int64), creases


def unpack_loop(numbers: Array, creases: IntArray, sheet: Sheet, lines: Sequence[Array]) -> TrimLoop:
    """The loop that `pack_loop` gave as numbers."""
    steps, last = np.zeros((len(numbers), 2)), np.zeros(2)
    for k, (number, told) in enumerate(zip(numbers, _told(creases, sheet, lines), strict=True)):
        steps[k] = last = number + (last if np.isnan(told[0]) else told)
    return TrimLoop(steps / sheet.steps, np.abs(creases) - 1)


def pack_rims(loop: TrimLoop) -> list[list[int]]:
    """First side, number of sides and width in whole units of the rims of a loop."""
    if loop.rims is None:
        return []
    # What is hardly anything is a rim all the same.
    widths = np.where(loop.rims > 0.0, np.maximum(np.rint(loop.rims * RIMS), 1.0), 0.0).astype(np.int64)
    bounds = [0, *(np.flatnonzero(np.diff(widths)) + 1).tolist(), len(widths)]
    return [[a, b - a, int(widths[a])] for a, b in pairwise(bounds) if widths[a]]


def unpack_rims(loop: TrimLoop, numbers: Sequence[Sequence[int]]) -> TrimLoop:
    """The loop with the rims that `pack_rims` gave as numbers.

    Raises
    ------
    ValueError
        Tells of what is no rim: it has no side, reaches beyond the last one, has no width, or is a crease.
    """
    if not len(numbers):
        return loop
    rims = np.zeros(len(loop.creases))
    for k, (first, count, width) in enumerate(numbers):
        sides = slice(first, first + count)
        if min(first, count - 1, width - 1, len(rims) - first - count) < 0 or (loop.creases[sides] >= 0).any():
            raise ValueError(f"rims[{k}] is {first:g}, {count:g}, {width:g}, wanted sides without crease and a width")
        rims[sides] = width / RIMS
    return replace(loop, rims=rims)


def _whole_runs(creases: IntArray, lines: Sequence[Array]) -> list[IntArray]:
    """Sides of a loop that follow each other along one crease, as many as it has."""
    numbers = np.abs(creases)
    starts = np.flatnonzero(numbers != np.roll(numbers, 1))
    starts = starts if len(starts) else np.zeros(1, dtype=np.int64)
    counts = np.diff(np.append(starts, starts[0] + len(numbers)))
    return [
        np.arange(start, start + count) % len(numbers)
        for start, count in zip(starts.tolist(), counts.tolist(), strict=True)
        if numbers[start] > 0 and count == len(lines[numbers[start] - 1]) - 1
    ]


def _told(creases: IntArray, sheet: Sheet, lines: Sequence[Array]) -> Array:
    """(n, 2) whole steps at which creases tell the vertices of a loop to be, NaN for those that none tells."""
    told = np.full((len(creases), 2), np.nan)
    for sides in _whole_runs(creases, lines):
        number = int(creases[sides[0]])
        line = lines[abs(number) - 1]
        told[np.append(sides, sides[-1] + 1) % len(told)] = sheet.steps_at(line if number > 0 else line[::-1])
    return told
