"""Beams at creases, each on the face that it meets there."""

from collections.abc import Sequence

import numpy as np

from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.feet import tabulate
from bsmap_cli.fit.heights import HeightField
from bsmap_cli.fit.labels import GAP, OUTLIER, Runs, fill, met_at, runs_of
from bsmap_cli.model import IntArray

BEYOND = 4
"""Beams at the end of a run that may lie beyond its crease."""


def on_their_sides(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Labels, the last beams of runs before another face given to that one where they lie beyond the crease.

    Which of two surfaces is nearer along a beam, the noise does not touch: on the other side of their crease it is the
    other one. Where the two do not cross between the runs, or that one does not explain the beam, they do not meet
    there, and it stays.
    """
    table, labels = tabulate(fields), labels.copy()
    (row, start, stop, label), near = _joined(runs_of(labels))
    half = np.minimum((stop - start) // 2, 2 * BEYOND)
    for own, other, step in ((near, near + 1, -1), (near + 1, near, 1)):
        end, begin = (stop[own] - 1, start[other]) if step < 0 else (start[own], stop[other] - 1)
        # The last two, inside of both runs, tell which surface is nearer on either side.
        at = np.column_stack(
            [end[:, None] + step * np.arange(BEYOND), end + step * half[own], begin - step * half[other]]
        )
        at = np.clip(at, 0, labels.shape[1] - 1)
        r = np.broadcast_to(row[own, None], at.shape)
        k, i = np.nonzero((np.arange(BEYOND + 2) < half[own, None]) | (np.arange(BEYOND + 2) >= BEYOND))
        seen = grid.hit[r[k, i], at[k, i]]
        k, i = k[seen], i[seen]
        to_own, to_other = np.full((2, *at.shape), np.nan)
        for way, face in ((to_own, label[own]), (to_other, label[other])):
            way[k, i] = met_at(grid, table, face[k], r[k, i], at[k, i]).beyond
        sign = np.sign(to_own - to_other)
        inner, across = sign[:, BEYOND, None], sign[:, BEYOND + 1, None]
        sign = sign[:, :BEYOND]
        # From the end of the run on as far as beams of the rest allow.
        wrong = np.logical_and.accumulate((sign * inner < 0.0) | np.isnan(sign), axis=1) & (across * inner < 0.0)
        wrong &= labels[r[:, :BEYOND], at[:, :BEYOND]] == label[own, None]
        k, i = np.nonzero(wrong)
        explained = np.abs(to_other[k, i]) < OUTLIER * sigma
        k, i = k[explained], i[explained]
        labels[r[k, i], at[k, i]] = label[other[k]]
    return fill(grid, labels)


def closed_at_creases(grid: BeamGrid, labels: IntArray, fields: Sequence[HeightField], sigma: float) -> IntArray:
    """Labels, the few beams of the rest between two faces that cross there given to these, each on its side.

    Where they leave one of them unexplained, something stands in the crease, and they stay.
    """
    table, labels = tabulate(fields), labels.copy()
    (row, start, stop, label), near = _joined(runs_of(labels))
    near = near[(start[near + 1] > stop[near]) & (label[near] != label[near + 1])]
    half = [np.minimum((stop - start)[of] // 2, 2 * BEYOND) for of in (near, near + 1)]
    gap = stop[near, None] + np.arange(GAP)
    at = np.column_stack([gap, stop[near] - 1 - half[0], start[near + 1] + half[1]])
    between = np.column_stack([gap < start[near + 1, None], np.ones((len(near), 2), dtype=bool)])
    r = np.broadcast_to(row[near, None], at.shape)
    at = np.minimum(at, labels.shape[1] - 1)
    k, i = np.nonzero(between & grid.hit[r, at])
    to_first, to_second = np.full((2, *at.shape), np.nan)
    for way, face in ((to_first, label[near]), (to_second, label[near + 1])):
        way[k, i] = met_at(grid, table, face[k], r[k, i], at[k, i]).beyond
    sign = np.sign(to_first - to_second)
    first = sign[:, :GAP] == sign[:, GAP, None]
    miss = np.where(first, to_first[:, :GAP], to_second[:, :GAP])
    # One border between them: all beams of the first face come before all of the second.
    ordered = np.all(np.diff(np.where(between[:, :GAP], first, False).astype(np.int8), axis=1) <= 0, axis=1)
    explained = np.all((np.abs(miss) < OUTLIER * sigma) | np.isnan(miss), axis=1)
    crossing = sign[:, GAP] * sign[:, GAP + 1] < 0.0
    k, i = np.nonzero((ordered & explained & crossing)[:, None] & np.isfinite(miss))
    labels[r[k, i], at[k, i]] = np.where(first[k, i], label[near[k]], label[near[k] + 1])
    return fill(grid, labels)


def _joined(runs: Runs) -> tuple[Runs, IntArray]:
    """Runs, those of one face between which only a few beams are as one; and which have another one behind them."""
    row, start, stop, label = runs
    near = (row[1:] == row[:-1]) & (start[1:] - stop[:-1] <= GAP)
    same = near & (label[1:] == label[:-1])
    first, last = np.flatnonzero(np.append(True, ~same)), np.flatnonzero(np.append(~same, True))
    return Runs(row[first], start[first], stop[last], label[first]), np.flatnonzero(near[last[:-1]])
