"""Surfaces of low order for growing regions: polynomial heights over a plane, and vertical cylinders.

Both are linear in their unknowns, so that a region is held by sums (A, b, s): chi square of unknowns x is
x'A x - 2 b'x + s, and adding data is adding sums.
"""

from typing import NamedTuple

import numpy as np

from bsmap_cli.fit.blocks import Blocks
from bsmap_cli.model import Array

ORDERS = (3, 6, 10, 15)
"""Unknowns of polynomials of degree 1 to 4 in two variables."""
GRAZING = 0.05
"""Smallest sine between beam and surface that counts: flatter beams get the weight of this."""


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


def chi_square(sums: Sums, size: int) -> float:
    """Chi square of the best of the first `size` unknowns."""
    A, b = sums.A[:size, :size], sums.b[:size]
    scale = 1.0 / np.sqrt(np.maximum(np.diag(A), 1e-300))
    scaled = A * scale[:, None] * scale + 1e-11 * np.eye(size)
    return float(sums.s - (b * scale) @ np.linalg.solve(scaled, b * scale))


def polynomials(s: Array, t: Array) -> Array:
    """(n, 15) monomials up to degree 4, by degree."""
    one, ss, tt = np.ones_like(s), s * s, t * t
    terms = [
        one,
        s,
        t,
        ss,
        s * t,
        tt,
        ss * s,
        ss * t,
        s * tt,
        tt * t,
        ss * ss,
        ss * s * t,
        ss * tt,
        s * tt * t,
        tt * tt,
    ]
    return np.stack(terms, axis=-1)


def plane_rows(frame: PlaneFrame, blocks: Blocks) -> tuple[Array, Array, Array]:
    """Monomials (n, 15), heights (n,) and 1 / sine of incidence (n,) of blocks over a plane."""
    local = (blocks.points - frame.origin) @ frame.axes
    sine = np.maximum(np.abs(blocks.directions @ frame.axes[:, 2]), GRAZING)
    return polynomials(local[:, 0], local[:, 1]), local[:, 2], 1.0 / sine


def cylinder_rows(frame: CylinderFrame, blocks: Blocks) -> tuple[Array, Array, Array]:
    """Rows of x^2 + y^2 = 2 a x + 2 b y + c about the frame's centre, their data, and weights' roots."""
    xy = blocks.points[:, :2] - frame.centre
    rows = np.column_stack([2.0 * xy, np.ones(len(xy))])
    along = np.abs(np.einsum("nk,nk->n", xy, blocks.directions[:, :2]))
    return rows, np.sum(xy * xy, axis=1), 1.0 / (2.0 * np.maximum(along, 2.0 * GRAZING * frame.radius))


def sums_of(frame: Frame, blocks: Blocks, sigma: float) -> Sums:
    """Sums of all blocks together."""
    rows = plane_rows(frame, blocks) if isinstance(frame, PlaneFrame) else cylinder_rows(frame, blocks)
    N, data, root = rows
    root = root * np.sqrt(blocks.counts) / sigma
    N, data = N * root[:, None], data * root
    return Sums(N.T @ N, N.T @ data, float(data @ data))


def fit_plane_frame(blocks: Blocks, rough_normal: Array | None = None) -> PlaneFrame:
    """Plane through blocks by least squares along the beams, after one by distance (or with a normal known about)."""
    origin = np.average(blocks.points, axis=0, weights=blocks.counts)
    if rough_normal is None:
        centred = (blocks.points - origin) * np.sqrt(blocks.counts)[:, None]
        rough_normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    frame = PlaneFrame(origin, axes_of(rough_normal))
    for _ in range(2):
        N, data, root = plane_rows(frame, blocks)
        root = root * np.sqrt(blocks.counts)
        slopes = np.linalg.lstsq(N[:, :3] * root[:, None], data * root, rcond=1e-9)[0]
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
