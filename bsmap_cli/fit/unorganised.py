"""Points without any order -> SurfaceMap: smooth regions, each fitted as a height field like a face of a data set.

What the order of scans and beams tells is not there: noise is taken to lie across the surface, a face ends where its
points end and not in a crease, and there are no poses whose errors the covariance could hold.
"""

import itertools
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.errors import BsmapError, ParameterError
from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.fit.coverage import cover
from bsmap_cli.fit.division import bases
from bsmap_cli.fit.growing import (
    BEND,
    FINEST_NOISE,
    Cells,
    Normals,
    Scale,
    find_normals,
    group,
    grow,
    measure_scale,
    thin,
)
from bsmap_cli.fit.heights import Base, CylinderBase, HeightField, flat_knots, offset, plane_base
from bsmap_cli.fit.lowmodels import fit_cylinder_frame
from bsmap_cli.fit.selection import Fitted, fit_heights, refit
from bsmap_cli.fit.surface import residuals_of
from bsmap_cli.fit.surfaces import spline_of
from bsmap_cli.model import Array, BSplineSurface, DataSet, IntArray, PosePart, ScatteredCloud, SurfaceMap, TrimLoop
from bsmap_cli.params import FitParams
from bsmap_cli.track import Track, silent

NAME, MOVEMENT = "set-01", "unorganised"
REMARK = "no scan order: faces end where their points end, without creases, and the covariance has no pose part"
FEWEST_CELLS, FEWEST_POINTS = 12, 30
"""Of a face; what is smaller is left to the rest."""
STRICTER, TRIES = 1.5, 4
"""How much less neighbours may bend in a region grown anew; how often one is, from the second time by direction."""
WIDEST = np.radians(50.0)
"""Between a face's normals and their mean, for a height field over a plane."""
GATE = 3.5
"""Standard deviations within which a point is on a face."""
BELIEVED = 0.8
"""Share of its points that a face must fit."""
GREEDIEST = 3.0
"""Times its region's points that a face may have in the end: more are a jumble through which it happens to run."""
ROUNDS = 3
"""Of dividing the points anew by the fitted surfaces; each reaches a neighbourhood farther."""
LEVELS, FINEST = 3, 5.0
"""Sizes of cells, each half of the one before; the finest in standard deviations of the noise."""
CANDIDATES = 3
"""Faces among which a point chooses."""
MOST_BLOCKS = 5000
POINTS_A_BLOCK = 8


class _Division(NamedTuple):
    """labels : (n,) face of each, -1 for the rest.  fitted : by number.  sigma : metres."""

    labels: IntArray
    fitted: list[Fitted]
    sigma: float


def fit_unorganised(cloud: ScatteredCloud, params: FitParams, *, track: Track = silent) -> SurfaceMap:
    """Divide scattered points into smooth faces and fit a trimmed surface to each; the points' order does not matter.

    Raises
    ------
    ParameterError
        Another method than `faces` is asked for.
    BsmapError
        Where no face is found.
    """
    if params.method != "faces":
        raise ParameterError(f"method {params.method} needs scan lines, and these points have none; use faces")
    points = _distinct(cloud.points)
    if len(points) < FEWEST_POINTS:
        raise BsmapError(f"no surface can be fitted: {len(points)} distinct points, wanted {FEWEST_POINTS} or more")
    scale = measure_scale(points)
    found = _find_faces(points, scale, track)
    surfaces = _surfaces(points, found, scale)
    if not surfaces:
        raise BsmapError(
            f"no surface can be fitted: no smooth face in {len(points)} points {scale.spacing:.3g} m apart"
        )
    in_faces = sum(surface.residuals.points for surface in surfaces)
    figures = {
        "points": len(points),
        "repeated": len(cloud.points) - len(points),
        "in_faces": in_faces,
        "rest": len(points) - in_faces,
        "sigma": found.sigma,
        "spacing": scale.spacing,
        "remark": REMARK,
    }
    data_set = DataSet(NAME, MOVEMENT, 0, 0, len(points))
    return SurfaceMap(tuple(surfaces), (data_set,), (), {"fit": {NAME: figures}})


def _distinct(points: Array) -> Array:
    """Points (n, 3), each once, ascending: from here on their order in the file is forgotten."""
    points = points[np.lexsort(points.T)]
    return points[np.append(True, np.any(np.diff(points, axis=0) != 0.0, axis=1))]


def _find_faces(points: Array, scale: Scale, track: Track) -> _Division:
    """Faces of coarse cells first, then in what is left those of finer ones; in the end all points choose anew."""
    labels, fitted = np.full(len(points), -1), list[Fitted]()
    for level in range(LEVELS):
        track("faces", level, LEVELS + 1)
        size, rest = scale.cell / 2.0**level, np.flatnonzero(labels < 0)
        if len(rest) < FEWEST_POINTS or (level > 0 and size < FINEST * scale.sigma):
            break
        new, of_rest = _grow_faces(points[rest], size, scale.sigma)
        labels[rest] = np.where(of_rest >= 0, of_rest + len(fitted), -1)
        fitted += new
    track("faces", LEVELS, LEVELS + 1)
    cells = thin(points, scale.cell)
    near = _most(labels, cells, len(fitted))[find_normals(cells.points).neighbours]
    labels = _divide(points, cells, near, fitted, scale.sigma)
    fitted, labels = _kept(fitted, labels, _counts(labels, len(fitted)) >= FEWEST_POINTS)
    bases = [fit.field.base for fit in fitted]
    sigma = _noise(points, labels, fitted, FINEST_NOISE * scale.spacing)
    fitted = [_fit(of_face, sigma, base=base) for (_, of_face), base in zip(_parts(points, labels), bases, strict=True)]
    track("faces", LEVELS + 1, LEVELS + 1)
    return _believed(points, _Division(labels, fitted, sigma))


def _grow_faces(points: Array, size: float, sigma: float) -> tuple[list[Fitted], IntArray]:
    """Faces grown from cells of side `size`, and the label (n,) of each point."""
    cells = thin(points, size)
    normals = find_normals(cells.points)
    regions = _regions(cells, normals, sigma)
    of_cell = np.full(len(cells.points), -1)
    for number, members in enumerate(regions):
        of_cell[members] = number
    seeds = labels = of_cell[cells.of_point]
    fitted = [_fit(of_face, sigma, normals.normals[cells.of_point[index]]) for index, of_face in _parts(points, labels)]
    for _ in range(ROUNDS):
        labels = _divide(points, cells, of_cell[normals.neighbours], fitted, sigma)
        of_cell = _most(labels, cells, len(fitted))
    before, after = _counts(seeds, len(fitted)), _counts(labels, len(fitted))
    return _kept(fitted, labels, (after >= FEWEST_POINTS) & (after <= GREEDIEST * before))


def _regions(cells: Cells, normals: Normals, sigma: float) -> list[IntArray]:
    """Regions that one height field can follow; those that bend too far are grown anew more strictly."""
    noise = sigma / np.sqrt(np.median(cells.counts))
    waiting = [(0, part) for part in grow(cells.points, normals, np.arange(len(cells.points)), BEND, noise)]
    done = []
    while waiting:
        tries, members = waiting.pop()
        if len(members) < FEWEST_CELLS:
            continue
        of_members = normals.normals[members]
        if _spread(of_members) < WIDEST or _is_round(cells.points[members], of_members, noise):
            done.append(members)
        elif tries < TRIES:
            directions = _directions(of_members) if tries else np.zeros(len(members), dtype=np.int64)
            for direction in range(3):
                parts = grow(cells.points, normals, members[directions == direction], BEND / STRICTER, noise)
                waiting += [(tries + 1, part) for part in parts]
    return sorted(done, key=lambda members: (-int(cells.counts[members].sum()), int(members[0])))


def _directions(normals: Array) -> IntArray:
    """Which of three main directions each of the normals (n, 3), of either sign, is nearest to.

    The first has most normals around it, the second most of those that are far from it, the third is across both.
    """
    sample = normals[np.linspace(0, len(normals) - 1, min(300, len(normals))).astype(np.int64)]
    near = np.sum(np.abs(sample @ normals.T) > np.cos(np.radians(20.0)), axis=1)
    first = sample[np.argmax(near)]
    second = sample[np.argmax(np.where(np.abs(sample @ first) < np.cos(np.radians(45.0)), near, -1))]
    third = np.cross(first, second)
    main = np.stack([first, second, third / max(float(np.linalg.norm(third)), 1e-12)])
    return np.asarray(np.argmax(np.abs(normals @ main.T), axis=1))


def _spread(normals: Array) -> float:
    """Angle to the main direction below which all but a twentieth of normals (n, 3), of either sign, lie."""
    main = np.linalg.eigh(normals.T @ normals)[1][:, -1]
    return float(np.arccos(np.clip(np.percentile(np.abs(normals @ main), 5.0), 0.0, 1.0)))


def _is_round(points: Array, normals: Array, noise: float) -> bool:
    """Whether points (n, 3) lie on a vertical cylinder."""
    frame = fit_cylinder_frame(_single(points, normals))
    if frame is None:
        return False
    off = np.hypot(*(points[:, :2] - frame.centre).T) - frame.radius
    return bool(np.sqrt(np.mean(off**2)) < 3.0 * noise + 0.01 * frame.radius)


def _single(points: Array, directions: Array) -> Blocks:
    none = np.zeros(len(points), dtype=np.int64)
    return Blocks(points, directions, np.ones(len(points)), none, none.astype(float), none)


def _parts(points: Array, labels: IntArray) -> list[tuple[IntArray, Array]]:
    """Numbers and places of the points of each face."""
    order = np.argsort(labels, kind="stable")
    edges = np.searchsorted(labels[order], np.arange(int(labels.max(initial=-1)) + 2))
    return [(index := order[a:b], points[index]) for a, b in itertools.pairwise(edges)]


def _fit(points: Array, sigma: float, normals: Array | None = None, base: Base | None = None) -> Fitted:
    """Height field through points (n, 3) of a face; its base is chosen by their normals (n, 3) where none is given."""
    if base is None:
        assert normals is not None
        base = _choose(points, normals, sigma)
    local = base.local(points)[:, :2]
    size = _block_size(local, len(points))
    blocks = _blocks(points, base, size)
    low, high = local.min(axis=0) - 0.02, local.max(axis=0) + 0.02
    fitted = fit_heights(blocks, base, low, high, sigma)
    # The noise lies across the surface, which now is known.
    normal = offset(fitted.field, blocks.points)[1]
    return refit(fitted.field, blocks._replace(directions=normal), sigma)


def _choose(points: Array, normals: Array, sigma: float) -> Base:
    main = np.linalg.eigh(normals.T @ normals)[1][:, -1]
    if _spread(normals) < WIDEST:
        rough = plane_base(points, main)
        return bases(_blocks(points, rough, _block_size(rough.local(points), len(points))), sigma)[0]
    cells = group(points, points, 2.0 * _block_size(points, len(points)))
    first = np.unique(cells.of_point, return_index=True)[1]
    row = ((cells.points[:, 2] - cells.points[:, 2].min()) / 0.1).astype(np.int64)
    blocks = _single(cells.points, normals[first])._replace(counts=cells.counts.astype(float), row=row)
    frame = fit_cylinder_frame(blocks)
    if frame is None:
        return plane_base(points, main)
    angles = np.arctan2(*(cells.points[:, :2] - frame.centre).T[::-1])
    return CylinderBase(frame.centre, frame.radius, float(np.angle(np.mean(np.exp(1j * angles)))))


def _block_size(flat: Array, count: int) -> float:
    """Metres of a block's side: some points a block, and not too many blocks."""
    area = float(np.prod(np.maximum(np.ptp(flat[:, :2], axis=0), 1e-3)))
    return float(np.sqrt(area / min(MOST_BLOCKS, max(count / POINTS_A_BLOCK, 9.0))))


def _blocks(points: Array, base: Base, size: float) -> Blocks:
    """Mean points of the cells of a base, with directions across it."""
    local = base.local(points)[:, :2]
    cells = group(points, local, size)
    flat = HeightField(base, np.zeros(2), np.ones(2), flat_knots(), np.zeros((2, 2)))
    across = offset(flat, cells.points)[1]
    t = base.local(cells.points)[:, 1]
    row = ((t - t.min()) / size).astype(np.int64)
    none = np.zeros(len(row), dtype=np.int64)
    return Blocks(cells.points, across, cells.counts.astype(float), row, none.astype(float), none)


def _divide(points: Array, cells: Cells, near: IntArray, fitted: list[Fitted], sigma: float) -> IntArray:
    """Label (n,) of each point: of the faces nearby, the one that it lies on best; -1 where it lies on none.

    near : (m, k) labels of each cell and its neighbours.
    """
    best, labels = np.full(len(points), GATE * sigma), np.full(len(points), -1)
    for _ in range(CANDIDATES):
        candidate = near[np.arange(len(near)), np.argmax(near >= 0, axis=1)]
        near = np.where(near == candidate[:, None], -1, near)
        of_point = candidate[cells.of_point]
        off = _distances(points, of_point, fitted)
        better = off < best
        best[better], labels[better] = off[better], of_point[better]
    return labels


def _distances(points: Array, labels: IntArray, fitted: list[Fitted]) -> Array:
    """(n,) of points to their faces, metres; infinite for the rest."""
    off = np.full(len(points), np.inf)
    for number, (index, of_face) in enumerate(_parts(points, labels)):
        if len(index):
            off[index] = np.abs(offset(fitted[number].field, of_face)[0])
    return off


def _most(labels: IntArray, cells: Cells, faces: int) -> IntArray:
    """Label of each cell: of the face that has most of its points, -1 where half of them are on none."""
    on = labels >= 0
    key, count = np.unique(cells.of_point[on] * max(faces, 1) + labels[on], return_counts=True)
    order = np.argsort(count, kind="stable")
    out = np.full(len(cells.points), -1)
    cell, label, count = key[order] // max(faces, 1), key[order] % max(faces, 1), count[order]
    enough = 3 * count >= cells.counts[cell]
    out[cell[enough]] = label[enough]
    return out


def _counts(labels: IntArray, faces: int) -> IntArray:
    """(faces,) points of each face."""
    return np.bincount(labels[labels >= 0], minlength=faces)


def _kept(fitted: list[Fitted], labels: IntArray, kept: NDArray[np.bool_]) -> tuple[list[Fitted], IntArray]:
    """Some of the faces, and the labels numbered anew."""
    new = np.append(np.where(kept, np.cumsum(kept) - 1, -1), -1)
    return [fit for fit, keep in zip(fitted, kept, strict=True) if keep], np.asarray(new[labels])


def _noise(points: Array, labels: IntArray, fitted: list[Fitted], least: float) -> float:
    """Metres, standard deviation of a point: as points show it, or more, where means of neighbours do, or `least`."""
    off, means = [], []
    for (_, of_face), fit in zip(_parts(points, labels), fitted, strict=True):
        base = fit.field.base
        blocks = _blocks(of_face, base, _block_size(base.local(of_face), len(of_face)))
        off.append(np.abs(offset(fit.field, of_face)[0]))
        means.append(np.abs(offset(fit.field, blocks.points)[0]) * np.sqrt(blocks.counts))
    if not off:
        return least
    single = float(np.median(np.concatenate(off))) / 0.6745
    return max(least, single, min(float(np.median(np.concatenate(means))) / 0.6745, 3.0 * single))


def _believed(points: Array, found: _Division) -> _Division:
    """The division without outliers, and without the faces that many of their points deny."""
    off = _distances(points, found.labels, found.fitted)
    labels = np.where(off < GATE * found.sigma, found.labels, -1)
    before, after = (_counts(x, len(found.fitted)) for x in (found.labels, labels))
    fitted, labels = _kept(found.fitted, labels, (after >= BELIEVED * before) & (after >= FEWEST_POINTS))
    return _Division(labels, fitted, found.sigma)


def _surfaces(points: Array, found: _Division, scale: Scale) -> list[BSplineSurface]:
    """Trimmed surfaces, those of most points first."""
    middle = (points[:, :2].min(axis=0) + points[:, :2].max(axis=0)) / 2.0
    # Without poses, without their errors; the middle of the cloud stands for the place of the sensor.
    pose = (PosePart(NAME, middle, np.zeros((3, 3))),)
    parts = _parts(points, found.labels)
    order = sorted(range(len(parts)), key=lambda number: (-len(parts[number][0]), number))
    surfaces: list[BSplineSurface] = []
    for number in order:
        fitted, of_face = found.fitted[number], parts[number][1]
        trims = _trims(fitted.field, of_face, scale.spacing)
        if trims:
            spline, covariance = spline_of(fitted, pose)
            residuals = residuals_of(np.abs(offset(fitted.field, of_face)[0]))
            name = f"{NAME}/{len(surfaces) + 1:02d}"
            surfaces.append(BSplineSurface(name, (NAME,), *spline, covariance, residuals, trims))
    return surfaces


def _trims(field: HeightField, points: Array, spacing: float) -> tuple[TrimLoop, ...]:
    local = field.base.local(points)
    loops = (np.clip(field.parameters(loop), 0.0, 1.0) for loop in cover(local[:, :2], 0.5 * spacing))
    return tuple(TrimLoop(loop, np.full(len(loop), -1)) for loop in loops)
