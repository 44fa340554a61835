"""Surfaces of low order for growing regions: polynomial heights over a plane, and vertical cylinders.

Both are linear in their unknowns, so that a region is held by sums (A, b, s): chi square of unknowns x is
x'A x - 2 b'x + s, and adding data is adding sums.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.model import Array

ORDERS = (3, 6, 10, 15)
"""Unknowns of polynomials of degree 1 to 4 in two variables."""
GRAZING = 0.05
"""Smallest sine between beam and surface that counts: flatter beams get the weight of this."""
AXES = np.array([a for a in itertools.product((-1.0, 0.0, 1.0), repeat=3) if a > (0.0, 0.0, 0.0)])
"""(13, 3) directions; no axis is farther than 28 degrees from all of them."""
BASINS, TILTS = 3, 8
"""Of them, how many are followed, and for how many steps."""
ENOUGH_BLOCKS = 300, 1500
"""Evenly taken, to tell directions apart and to follow them: heights over the base make up for what the axis misses."""


class Sums(NamedTuple):
    """A (k, k), b (k,), s of weighted least squares."""

    A: Array
    b: Array
    s: float

    def plus(self, other: "Sums") -> "Sums":
        return Sums(self.A + other.A, self.b + other.b, self.s + other.s)


class PlaneFrame(NamedTuple):
    """origin (3,) in map; axes (3, 3), columns s, t and the normal in map."""

    origin: Array
    axes: Array


class CylinderFrame(NamedTuple):
    """Vertical cylinder about which the equation is made linear: centre (2,) in map, radius metres."""

    centre: Array
    radius: float


Frame = PlaneFrame | CylinderFrame


def chi_squares(sums: Sums, sizes: Sequence[int]) -> Array:
    """Chi squares (k,) of the best of the first so many unknowns, sizes (k,) ascending, out of one factorisation."""
    n = sizes[-1]
    A, b = sums.A[:n, :n], sums.b[:n]
    scale = 1.0 / np.sqrt(np.maximum(A.diagonal(), 1e-300))
    bordered = np.zeros((n + 1, n + 1))
    bordered[:n, :n] = A * scale[:, None] * scale
    bordered[n, :n] = b * scale
    bordered.flat[:: n + 2] += 1e-11
    bordered[n, n] = 2.0 * sums.s + 1.0  # more than can be explained: keeps the matrix positive definite
    explained = np.cumsum(np.linalg.cholesky(bordered)[n, :n] ** 2)
    return np.asarray(sums.s - explained[np.array(sizes) - 1])


def polynomials(s: Array, t: Array, size: int) -> Array:
    """(n, size) monomials by degree, at most up to degree 4."""
    out = np.empty((size, len(s)))
    out[0] = 1.0
    first = 0
    for degree in range(1, ORDERS.index(size) + 2):
        stop = first + degree
        np.multiply(out[first:stop], s, out=out[stop : stop + degree])
        np.multiply(out[stop - 1], t, out=out[stop + degree])
        first = stop
    return out.T


def plane_rows(frame: PlaneFrame, blocks: Blocks, size: int = ORDERS[-1]) -> tuple[Array, Array, Array]:
    """First monomials (n, size), heights (n,) and 1 / sine of incidence (n,) of blocks over a plane."""
    local = (blocks.points - frame.origin) @ frame.axes
    sine = np.maximum(np.abs(blocks.directions @ frame.axes[:, 2]), GRAZING)
    return polynomials(local[:, 0], local[:, 1], size), local[:, 2], 1.0 / sine


def cylinder_rows(frame: CylinderFrame, blocks: Blocks) -> tuple[Array, Array, Array]:
    """Rows of x^2 + y^2 = 2 a x + 2 b y + c about the frame's centre, their data, and weights' roots."""
    xy = blocks.points[:, :2] - frame.centre
    rows = np.column_stack([2.0 * xy, np.ones(len(xy))])
    along = np.abs(np.einsum("nk,nk->n", xy, blocks.directions[:, :2]))
    return rows, np.sum(xy * xy, axis=1), 1.0 / (2.0 * np.maximum(along, 2.0 * GRAZING * frame.radius))


def weighted_rows(frame: Frame, blocks: Blocks, sigma: float) -> tuple[Array, Array]:
    """Rows (n, k) and data (n,) of blocks in standard deviations."""
    rows = plane_rows(frame, blocks) if isinstance(frame, PlaneFrame) else cylinder_rows(frame, blocks)
    N, data, root = rows
    root = root * np.sqrt(blocks.counts) / sigma
    return N * root[:, None], data * root


def sums_of_rows(N: Array, data: Array) -> Sums:
    """Sums of weighted rows (n, k) and data (n,)."""
    return Sums(N.T @ N, N.T @ data, float(data @ data))


def sums_of(frame: Frame, blocks: Blocks, sigma: float) -> Sums:
    """Sums of all blocks together."""
    return sums_of_rows(*weighted_rows(frame, blocks, sigma))


def fit_plane_frame(blocks: Blocks, rough_normal: Array | None = None) -> PlaneFrame:
    """Plane through blocks by least squares along the beams, after one by distance (or with a normal known about)."""
    origin = np.average(blocks.points, axis=0, weights=blocks.counts)
    if rough_normal is None:
        centred = (blocks.points - origin) * np.sqrt(blocks.counts)[:, None]
        rough_normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    frame = PlaneFrame(origin, axes_of(rough_normal))
    for _ in range(2):
        N, data, root = plane_rows(frame, blocks, 3)
        root = root * np.sqrt(blocks.counts)
        slopes = np.linalg.lstsq(N * root[:, None], data * root, rcond=1e-9)[0]
        normal = frame.axes @ np.array([-slopes[1], -slopes[2], 1.0])
        frame = PlaneFrame(frame.origin + slopes[0] * frame.axes[:, 2], axes_of(normal))
    return frame


def axes_of(normal: Array) -> Array:
    """(3, 3) columns s (level, or x where the normal is steep), t and the unit normal."""
    n = normal / np.linalg.norm(normal)
    level = np.array([-n[1], n[0], 0.0])
    s = level if np.linalg.norm(level) > 0.5 else np.array([1.0, 0.0, 0.0])
    s = s - (s @ n) * n
    s /= np.linalg.norm(s)
    return np.column_stack([s, np.cross(n, s), n])


def fit_cylinder_frame(blocks: Blocks) -> CylinderFrame | None:
    """Vertical cylinder through blocks; None where they lie on no circle."""
    centre = np.average(blocks.points[:, :2], axis=0, weights=blocks.counts)
    frame = CylinderFrame(centre, 1.0)
    root = np.sqrt(blocks.counts)
    for step in range(4):
        N, data, by_angle = cylinder_rows(frame, blocks)
        weight = root if step == 0 else root * by_angle
        a, b, c = np.linalg.lstsq(N * weight[:, None], data * weight, rcond=1e-9)[0]
        square = c + a * a + b * b
        if not 0.0025 < square < 25.0:
            return None
        frame = CylinderFrame(frame.centre + np.array([a, b]), float(np.sqrt(square)))
    return frame


def turned(blocks: Blocks, axes: Array | None) -> Blocks:
    """Blocks in a frame with columns `axes` (3, 3) in map; None: as they are."""
    return blocks if axes is None else blocks._replace(points=blocks.points @ axes, directions=blocks.directions @ axes)


def fit_axis(blocks: Blocks) -> Array | None:
    """Frame (3, 3) whose third column is the axis of the cylinder through blocks; None where they lie on none.

    Directions all around are tried with a linear fit of the circle across them; from the best ones Gauss and Newton.
    """
    few, blocks = (blocks.pick(np.arange(0, len(blocks.counts), -(-len(blocks.counts) // n))) for n in ENOUGH_BLOCKS)
    tried = [(found.misfit, k) for k, axis in enumerate(AXES) if (found := _lean(few, axes_of(axis))) is not None]
    best, least = None, np.inf
    for _, k in sorted(tried)[:BASINS]:
        axes = axes_of(AXES[k])
        for _ in range(TILTS):
            found = _lean(blocks, axes)
            if found is None:
                break
            if found.misfit < least:
                best, least = axes, found.misfit
            axes = axes_of(axes @ np.append(found.tilt, 1.0))
    return best


class _Lean(NamedTuple):
    """How badly a cylinder with a given axis fits, and by how much (2,) the axis should lean."""

    misfit: float
    tilt: Array


def _lean(blocks: Blocks, axes: Array) -> _Lean | None:
    blocks = turned(blocks, axes)
    frame = fit_cylinder_frame(blocks)
    if frame is None:
        return None
    xy = blocks.points[:, :2] - frame.centre
    distance = np.linalg.norm(xy, axis=1)
    n = xy / np.maximum(distance, 1e-9)[:, None]
    sine = np.abs(np.einsum("nk,nk->n", n, blocks.directions[:, :2]))
    root = np.sqrt(blocks.counts) / np.maximum(sine, GRAZING)
    z = blocks.points[:, 2] - blocks.points[:, 2].mean()
    rows = np.column_stack([z[:, None] * n, n, np.ones(len(n))]) * root[:, None]
    miss = (distance - frame.radius) * root
    return _Lean(float(miss @ miss), np.linalg.lstsq(rows, miss, rcond=1e-9)[0][:2])
