"""Faces of a data set: beams divided into smooth surfaces, each fitted as a height field over its own base."""

import itertools
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.fit.absorption import absorb
from bsmap_cli.fit.beams import BeamGrid
from bsmap_cli.fit.beliefs import believed, scale_left
from bsmap_cli.fit.blocks import Blocks, make_blocks, single_beams, thinned
from bsmap_cli.fit.clutter import find_planes
from bsmap_cli.fit.crossings import find_crossings
from bsmap_cli.fit.grazing import without_grazed_ends
from bsmap_cli.fit.heights import (
    Base,
    Bulge,
    CylinderBase,
    HeightField,
    PlaneBase,
    evaluate,
    flat_knots,
    offset,
    plane_base,
)
from bsmap_cli.fit.labels import (
    Runs,
    adopt,
    enclosed,
    fill,
    move_breaks,
    runs_of,
)
from bsmap_cli.fit.lowmodels import CylinderFrame, fit_cylinder_frame, fit_plane_frame, turned
from bsmap_cli.fit.misses import find_misses, without_alike, without_outliers, without_slipped_ends
from bsmap_cli.fit.pieces import find_pieces
from bsmap_cli.fit.regions import find_regions
from bsmap_cli.fit.seeds import PAIR_BEAMS, SEED_INCIDENCE
from bsmap_cli.fit.selection import LEAST_BLOCKS, Fitted, fit_heights, refit
from bsmap_cli.fit.sides import closed_at_creases, on_their_sides
from bsmap_cli.fit.unions import low_order_cost
from bsmap_cli.model import Array, IntArray

FEWEST_BEAMS = 12
"""Of a face; what is smaller is left to the rest."""
FARTHEST = 1.0
"""Metres by which a face's rectangle may grow towards its creases."""
STEEPEST_HEIGHTS = 3.0
"""Slope of the heights of a face over its base, 72 degrees."""
ASTRAY = 0.05
"""Share of its beams that may seem to meet a face from behind."""
LITTLE = 0.05
"""Share of its beams in which a face has hardly changed."""
CLOSE = 0.01
"""Metres from the first to the last scan of single beams taken together."""
MOST_ROWS = 10_000_000
"""Elements of a design matrix up to which a face is fitted to single beams."""
ENOUGH_STEPS = 10_000
"""Between neighbouring beams of a face, to tell how wide they usually are."""
ROUNDS = 2
"""Of dividing the beams anew by the fitted surfaces."""


class Faces(NamedTuple):
    """Faces of a data set.

    labels : (m, n) number of the face of each beam, -1 for the rest; a beam without return between beams of one face
    has that face's number.  sigma : metres, noise along the beam that block means show, in terms of single beams.
    """

    labels: IntArray
    fitted: list[Fitted]
    sigma: float


def find_faces(grid: BeamGrid) -> Faces:
    """Divide the beams into faces and fit each."""
    pieces = find_pieces(grid)
    regions, sigma = find_regions(grid, pieces)
    labels = np.full(grid.ranges.shape, -1)
    for number, members in enumerate(regions):
        for k in members:
            labels[pieces.row[k], pieces.start[k] : pieces.stop[k]] = number
    labels = _renumber(labels, grid)
    blocks = blocks_of_faces(grid, labels)
    fitted = [_fit(grid, labels == k, of_face, sigma) for k, of_face in enumerate(blocks)]
    noise = sigma * scale_left(fitted, blocks)
    misses = None
    for step in range(ROUNDS):
        fields = [f.field for f in fitted]
        misses = find_misses(grid, labels, fields, before=misses)
        divided = adopt(grid, without_outliers(misses, sigma), fields, sigma)
        divided = move_breaks(grid, divided, fields, sigma)
        misses = find_misses(grid, divided, fields, misses)
        misses = misses._replace(labels=without_alike(grid, misses, sigma))
        divided = without_slipped_ends(grid, misses, fields, sigma)
        divided = without_grazed_ends(grid, divided, fields, sigma)
        if step < ROUNDS - 1:
            divided = find_planes(grid, divided, sigma)
            labels, fitted = _fit_changed(grid, labels, divided, fitted, noise)
            after = absorb(grid, labels, [f.field for f in fitted], sigma)
            if np.any(after != labels):
                labels, fitted = _fit_changed(grid, labels, fill(grid, after), fitted, noise)
        else:
            labels, kept = _kept(divided, grid)
            fitted = _refit_all(grid, labels, [fields[k] for k in kept], noise)
    misses = find_misses(grid, labels, [f.field for f in fitted], before=misses)
    labels, kept = _kept(fill(grid, believed(grid, misses, sigma, noise)), grid)
    if not len(kept):
        return Faces(labels, [], noise)
    fitted = _widened(grid, labels, [fitted[k] for k in kept], noise)
    # Planes lie as before; what is bent was fitted anew to single beams, on other knots.
    bent = np.append([f.field.knots.size > 4 for f in fitted], False).astype(bool)
    misses = find_misses(grid, np.where(bent[labels], labels, -1), [f.field for f in fitted], before=misses)
    labels = fill(grid, np.where(bent[labels], believed(grid, misses, sigma, noise), labels))
    for number, one in enumerate(fitted):
        beams = (labels == number) & grid.hit
        points, directions = grid.points[beams], grid.directions[beams]
        few = len(points) < LEAST_BLOCKS * one.field.knots.size
        if few or _stands_on_edge(one.field, points) or _seen_from_both_sides(one.field, points, directions):
            labels[labels == number] = -1
    fields = [one.field for one in fitted]
    labels = on_their_sides(grid, labels, fields, sigma)
    labels = enclosed(grid, closed_at_creases(grid, labels, fields, sigma))
    labels, kept = _kept(labels, grid)
    return Faces(labels, [fitted[k] for k in kept], noise)


def _widened(grid: BeamGrid, labels: IntArray, fitted: list[Fitted], sigma: float) -> list[Fitted]:
    """Faces fitted anew on rectangles that hold their creases, where the old ones do not.

    Curved faces are fitted to single beams: the mean of eight does not lie on the surface that they hit; on a vault of
    2 m it is farther off than the fit errs.
    """
    crossings = find_crossings(grid, labels, [f.field for f in fitted])
    out = []
    bent = np.array([f.field.knots.size > 4 for f in fitted], dtype=bool)
    of_bent = _beams_of_faces(grid, np.where((labels >= 0) & bent[labels], labels, -1), len(fitted))
    pairs = zip(blocks_of_faces(grid, labels), of_bent, strict=True)
    for number, (old, (blocks, beams)) in enumerate(zip(fitted, pairs, strict=True)):
        field = old.field
        curved = bent[number] and len(beams.counts) * field.knots.size < MOST_ROWS
        at = field.base.local(crossings.points[np.any(crossings.faces == number, axis=1)])[:, :2]
        low = np.maximum(np.vstack([at, field.low]).min(axis=0), field.low - FARTHEST)
        high = np.minimum(np.vstack([at, field.high]).max(axis=0), field.high + FARTHEST)
        if np.any(low < field.low) or np.any(high > field.high):
            margin = 0.02 * (high - low)
            low = np.where(low < field.low, low - margin, low)
            high = np.where(high > field.high, high + margin, high)
            field = replace(field, low=low, high=high)
        if field is not old.field or bent[number]:
            # Means of beams hide what the beams themselves ask for.
            old = refit(field, beams if curved else blocks, sigma, choose=curved)
        out.append(old)
    return out


def _stands_on_edge(field: HeightField, points: Array) -> bool:
    """Whether a field is far too steep over its base at the beams' ends (n, 3): beams in one line tell no plane."""
    gradient = evaluate(field, field.parameters(field.base.local(points)))[1]
    return bool(np.median(np.sum(gradient**2, axis=1)) > STEEPEST_HEIGHTS**2)


def _seen_from_both_sides(field: HeightField, points: Array, directions: Array) -> bool:
    """Whether beams (n, 3) that end at points (n, 3) meet a field from either side, those that graze it aside.

    A cylinder can be laid through somebody near by, seen from outside, and a wall far behind, from inside.
    """
    if isinstance(field.base, PlaneBase) and field.knots.size == flat_knots().size:
        return False  # a plane has all of them on one side
    sine = np.sum(offset(field, points)[1] * directions, axis=1)
    behind, before = (np.count_nonzero(side * sine > SEED_INCIDENCE) for side in (1.0, -1.0))
    return bool(min(behind, before) > ASTRAY * (behind + before))


def _renumber(labels: IntArray, grid: BeamGrid) -> IntArray:
    return _kept(labels, grid)[0]


def _kept(labels: IntArray, grid: BeamGrid) -> tuple[IntArray, IntArray]:
    """Labels without the faces of too few beams or scans, numbered anew; and the old numbers."""
    number = int(labels.max(initial=-1)) + 1
    beams = np.bincount(labels[grid.hit & (labels >= 0)], minlength=number)
    scans = np.array([np.count_nonzero(np.any((labels == k) & grid.hit, axis=1)) for k in range(number)], dtype=int)
    kept = np.flatnonzero(((beams >= FEWEST_BEAMS) & (scans >= 3)) | ((beams >= 2 * PAIR_BEAMS) & (scans == 2)))
    new = np.full(number + 1, -1)
    new[kept] = np.arange(len(kept))
    return new[labels], kept


def blocks_of_faces(grid: BeamGrid, labels: IntArray) -> list[Blocks]:
    """Blocks of each face."""
    runs = runs_of(labels)
    blocks = make_blocks(grid, runs.row, runs.start, runs.stop)
    return [thinned(one) for one in _by_face(blocks, runs, int(labels.max(initial=-1)) + 1)]


def _beams_of_faces(grid: BeamGrid, labels: IntArray, faces: int) -> list[Blocks]:
    """Beams of each of so many faces; only those of scans that lie very close are taken together."""
    runs = runs_of(labels)
    beams = single_beams(grid, runs.row, runs.start, runs.stop)
    return [thinned(one, 1, CLOSE) for one in _by_face(beams, runs, faces)]


def _by_face(blocks: Blocks, runs: Runs, faces: int) -> list[Blocks]:
    """The blocks of runs, face by face."""
    face = runs.label[blocks.owner]
    blocks = blocks.pick(np.argsort(face.astype(np.int16 if faces < 2**15 else np.int64), kind="stable"))
    ends = np.cumsum(np.bincount(face, minlength=faces)).tolist()
    return [blocks.pick(slice(a, b)) for a, b in itertools.pairwise([0, *ends])]


def _fit_changed(
    grid: BeamGrid, before: IntArray, after: IntArray, fitted: list[Fitted], sigma: float
) -> tuple[IntArray, list[Fitted]]:
    """Labels `after`, numbered anew, and their faces; those that were `fitted` to nearly the same beams are kept."""
    labels, kept = _kept(after, grid)
    out = []
    for number, (old, blocks) in enumerate(zip(kept.tolist(), blocks_of_faces(grid, labels), strict=True)):
        member = labels == number
        changed = np.count_nonzero(member != (before == old)) if old < len(fitted) else len(member)
        if changed == 0:
            out.append(fitted[old])
        elif old < len(fitted) and _is_flat(fitted[old].field) and changed < LITTLE * np.count_nonzero(member):
            # What was flat with nearly the same beams stays so.
            field = fitted[old].field
            low, high = _rectangle(grid, member, field.base)
            out.append(refit(replace(field, low=low, high=high), blocks, sigma))
        else:
            out.append(_fit(grid, member, blocks, sigma))
    return labels, out


def _is_flat(field: HeightField) -> bool:
    return isinstance(field.base, PlaneBase) and field.knots.shape == (2, 2)


def _fit(grid: BeamGrid, member: NDArray[np.bool_], blocks: Blocks, sigma: float) -> Fitted:
    fits = [fit_heights(blocks, base, *_rectangle(grid, member, base), sigma) for base in bases(blocks, sigma)]
    return min(fits, key=lambda fitted: fitted.criterion)


def _refit_all(grid: BeamGrid, labels: IntArray, fields: list[HeightField], sigma: float) -> list[Fitted]:
    """Faces fitted anew on the knots that now pay; where beams ask for the other kind of base, from the beginning."""
    out = []
    for number, (field, blocks) in enumerate(zip(fields, blocks_of_faces(grid, labels), strict=True)):
        same = any(type(base) is type(field.base) for base in bases(blocks, sigma))
        out.append(refit(field, blocks, sigma, choose=True) if same else _fit(grid, labels == number, blocks, sigma))
    return out


def bases(blocks: Blocks, sigma: float) -> list[Base]:
    """Plane, or cylinder with any axis, around a sphere, too, where that is what the blocks lie on; both where neither.

    The cylinder around a sphere has an axis from which the blocks stay away.
    """
    frame = fit_plane_frame(blocks)
    low = low_order_cost(blocks, frame, sigma)
    plane = plane_base(blocks.points, frame.axes[:, 2])
    if not low.is_round:
        return [plane]
    blocks, bulge = turned(blocks, low.axes), None
    found = fit_cylinder_frame(blocks)
    if low.sphere is not None and low.axes is not None:
        x, y, z = (low.sphere.centre @ low.axes).tolist()
        found, bulge = CylinderFrame(np.array([x, y]), low.sphere.radius), Bulge(z, low.sphere.radius)
    if found is None:
        return [plane]
    angles = np.arctan2(*(blocks.points[:, :2] - found.centre).T[::-1])
    middle = float(np.angle(np.mean(np.exp(1j * angles))))
    cylinder = CylinderBase(found.centre, found.radius, middle, low.axes, bulge)
    return [cylinder, plane] if low.poor else [cylinder]


def _rectangle(grid: BeamGrid, member: NDArray[np.bool_], base: Base) -> tuple[Array, Array]:
    """Corners (2,) in s and t of the rectangle around a face's beams, with room for a cell of the grid beyond them."""
    place = np.flatnonzero(member & grid.hit)
    row, column = np.divmod(place, member.shape[1])
    at = base.local(grid.points.reshape(-1, 3)[place])[:, :2]
    low, high = at.min(axis=0), at.max(axis=0)
    st = np.full((int(np.ptp(row)) + 1, int(np.ptp(column)) + 1, 2), np.nan)
    st[row - row.min(), column - column.min()] = at
    margin = np.full(2, 0.02)
    every = 1 + len(row) // ENOUGH_STEPS
    for axis, some in ((0, st[:, ::every]), (1, st[::every])):
        steps = np.abs(np.diff(some, axis=axis)).reshape(-1, 2)
        steps = steps[np.isfinite(steps[:, 0])]
        if len(steps):
            usual = int(0.95 * (len(steps) - 1))
            margin = np.maximum(margin, 1.2 * np.partition(steps, usual, axis=0)[usual])
    margin = np.minimum(margin, 0.6)
    return low - margin, high + margin
