"""Runs of the outlines of faces along the curves in which they meet others, and the corners between two runs."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from bsmap_cli.merge.curves import APART, Curve, Shapes, covered, locate, onto
from bsmap_cli.model import Array, IntArray

OFF = 0.005
"""Metres from a corner to the curves that end there."""
KNOWN = 0.5
"""Metres that a run may be away from a corner where the other face's outline runs on along the curve. Scans of a
rotation lie 40 cm apart at the walls; floor and ceiling then lack the cells in corners to which the walls reach."""


class Run(NamedTuple):
    """Part of a loop along a curve: from vertex `first` to vertex `last`, at the lengths `start` and `end`."""

    curve: int
    first: int
    last: int
    start: float
    end: float

    @property
    def sign(self) -> int:
        """+1 where it runs as the curve does, else -1."""
        return 1 if self.end > self.start else -1


class Meeting(NamedTuple):
    """Where a run of a loop ends and the next one begins: the faces that meet there, and the point (3,)."""

    run: int
    following: int
    faces: tuple[int, ...]
    point: Array


class Known(NamedTuple):
    """Which way a loop runs along a curve (+1, -1), and where, lengths (k, 2), the other face's outline does."""

    sign: int
    others: Array


def find_runs(
    loop: Array, curves: Mapping[int, Curve], gap: float, known: Mapping[int, Known] = MappingProxyType({})
) -> list[Run]:
    """Runs of a loop (k, 3) in its order.

    Parameters
    ----------
    curves : those of its face under their numbers.
    gap : metres; a loop that leaves a curve by less than that, for less than twice of it, runs on along it.
    known : of curves along which it runs. Where the other face ends in the curve, sides up to `gap` off run along it.
    """
    along = _curves_of_sides(loop, curves, gap, known)
    starts = np.flatnonzero(along != np.roll(along, 1))
    runs = []
    for start, stop in zip(starts.tolist(), np.roll(starts, -1).tolist(), strict=True):
        if along[start] >= 0:
            t = locate(curves[int(along[start])], loop[[start, stop]])[0]
            runs.append(Run(int(along[start]), start, stop, float(t[0]), float(t[1])))
    return _one_sided(_long(_joined(_long(runs), loop, curves, gap)), loop, curves)


def _one_sided(runs: Sequence[Run], loop: Array, curves: Mapping[int, Curve]) -> list[Run]:
    """The runs, of two that run along the same part of a curve there and back only the nearer one.

    A face lies on one side of its crease: the other border of a narrow strip may be near, too.
    """
    off = [locate(curves[run.curve], open_part(loop, run.first, run.last))[1].mean() for run in runs]
    kept: list[Run] = []
    for k in sorted(range(len(runs)), key=lambda number: (off[number], number)):
        run = runs[k]
        against = (other for other in kept if run.curve == other.curve and run.sign != other.sign)
        if all(_shared(run, other) <= APART for other in against):
            kept.append(run)
    return sorted(kept, key=lambda run: run.first)


def _shared(one: Run, other: Run) -> float:
    """Metres of a curve that two runs have in common."""
    (a, b), (c, d) = sorted((one.start, one.end)), sorted((other.start, other.end))
    return min(b, d) - max(a, c)


def _long(runs: Sequence[Run]) -> list[Run]:
    return [run for run in runs if abs(run.end - run.start) > APART]


def _curves_of_sides(loop: Array, curves: Mapping[int, Curve], gap: float, known: Mapping[int, Known]) -> IntArray:
    """Of each side (k,) the nearest curve that it runs along, -1 for none."""
    length = np.linalg.norm(np.roll(loop, -1, axis=0) - loop, axis=1)
    best, number = np.full(len(loop), np.inf), np.full(len(loop), -1)
    for k, curve in sorted(curves.items()):
        t, off = locate(curve, loop)
        t, off = np.stack([t, np.roll(t, -1)]), np.maximum(off, np.roll(off, -1))
        low, high = t.min(axis=0)[:, None], t.max(axis=0)[:, None]
        seen = np.any((curve.seen[:, 0] < high + gap) & (curve.seen[:, 1] > low - gap), axis=1)
        way = np.abs(t[1] - t[0])
        near = off < curve.beside
        if k in known:
            sign, others = known[k]
            there = np.any((others[:, 0] <= low + APART) & (others[:, 1] >= high - APART), axis=1)
            near |= (off < gap) & there & ((t[1] - t[0]) * sign > 0.0)
        # Around a pillar a side leads from the end of the curve to its beginning: it is far shorter than the way back.
        along = near & (off < best) & (way > 0.5 * length) & (way < 2.0 * length) & seen
        best[along], number[along] = off[along], k
    return number


def _joined(runs: list[Run], loop: Array, curves: Mapping[int, Curve], gap: float) -> list[Run]:
    """The runs, those joined between which the loop leaves their curve little."""
    k = 0
    while k < len(runs) and len(runs) > 1:
        following = (k + 1) % len(runs)
        one, other = runs[k], runs[following]
        if _runs_on(one, other, loop, curves[one.curve], gap):
            whole = Run(one.curve, one.first, other.last, one.start, other.end)
            runs = [whole, *runs[1:-1]] if following == 0 else [*runs[:k], whole, *runs[k + 2 :]]
            k = max(k - 1, 0) if following else 0
        else:
            k += 1
    return runs


def _runs_on(one: Run, other: Run, loop: Array, curve: Curve, gap: float) -> bool:
    """Whether a loop leaves the curve of two runs little between them, and for a short way.

    Around the end of a narrow strip it comes back along the other side of it, near the curve, too.
    """
    if one.curve != other.curve or one.sign != other.sign:
        return False
    off = locate(curve, open_part(loop, one.last, other.first))[1]
    return bool(-APART < (other.start - one.end) * one.sign < 2.0 * gap and off.max(initial=0.0) < gap)


def open_part(loop: Array, first: int, last: int) -> Array:
    """Vertices (k, 3) of a loop from `first` to `last`, both among them."""
    return loop[np.arange(first, last + 1 if last >= first else last + 1 + len(loop)) % len(loop)]


def find_meetings(
    loop: Array,
    runs: Sequence[Run],
    curves: Mapping[int, Curve],
    others: Mapping[int, Array],
    shapes: Shapes,
    gap: float,
) -> list[Meeting]:
    """Where runs of a loop that follow each other meet, as far as what lies between them is little or known.

    others : (k, 2) lengths along each curve between which the other face runs along it.
    """
    out = []
    for k, one in enumerate(runs):
        following = (k + 1) % len(runs)
        other = runs[following]
        ends = loop[[one.last, other.first]]
        if one.curve == other.curve or np.linalg.norm(ends[1] - ends[0]) > 2.0 * KNOWN:
            continue
        faces = tuple(sorted({*curves[one.curve].pair, *curves[other.curve].pair}))
        point = onto([shapes[face] for face in faces], ends.mean(axis=0)[None], KNOWN)
        reach = np.linalg.norm(ends - point, axis=1).max() + gap / 2.0
        away = np.linalg.norm(open_part(loop, one.last, other.first) - point, axis=1).max()
        if away < reach and all(
            _comes_to(point, end, start, curves[number], others[number], gap)
            for number, end, start in ((one.curve, one.end, one.start), (other.curve, other.start, other.end))
        ):
            out.append(Meeting(k, following, faces, point[0]))
    return out


def _comes_to(point: Array, end: float, start: float, curve: Curve, other: Array, gap: float) -> bool:
    """Whether a corner (1, 3) lies on the curve of a run, and what lies between is short or the other face is there.

    end, start : where along the curve the run ends on the corner's side, and on the other one.
    """
    t, off = (float(value[0]) for value in locate(curve, point))
    if off >= OFF or abs(t - end) > abs(t - start):
        return False
    low, high = sorted((t, end))
    return high - low < (KNOWN if covered(other, low, high, gap) else 2.0 * gap)
