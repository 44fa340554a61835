"""Surfaces of low order for growing regions: polynomial heights over a plane, vertical cylinders, and spheres.

All are linear in their unknowns, so that a region is held by sums (A, b, s): chi square of unknowns x is
x'A x - 2 b'x + s, and adding data is adding sums.
"""

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.three import solve_three
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
UPRIGHT = 1e-4
"""Radians by which an axis that is right may still lean."""
GAINS = 0.05, 1e-3
"""Shares of the misfit that a step must gain to be followed by another: while axes are looked for, and of the best."""
ENOUGH_BLOCKS = 300, 1500
"""Evenly taken, to tell directions apart and for the best of them: heights over the base make up for what the axis
misses."""
LEAST_RADIUS, LARGEST_RADIUS, LARGEST_SPHERE = 0.05, 5.0, 20.0
"""Metres, of cylinders and spheres: what is wider is a polynomial."""
SPHERE_STEPS = 4
POLAR = 0.95
"""Sine of the latitude to which heights over the cylinder around a sphere are told."""
UNTOLD = 1e-12
"""Share of its own square by which an unknown that the rows do not tell is held near 0."""


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


class SphereFrame(NamedTuple):
    """Sphere about which the equation is made linear: centre (3,) in map, radius metres."""

    centre: Array
    radius: float


Frame = PlaneFrame | CylinderFrame | SphereFrame


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


def ball_rows(frame: CylinderFrame | SphereFrame, blocks: Blocks) -> tuple[Array, Array, Array]:
    """Rows of p^2 = 2 c p + d about the frame's centre, of p = (x, y) or (x, y, z), their data, and weights' roots."""
    size = len(frame.centre)
    p = blocks.points[:, :size] - frame.centre
    rows = np.column_stack([2.0 * p, np.ones(len(p))])
    along = np.abs(np.einsum("nk,nk->n", p, blocks.directions[:, :size]))
    return rows, np.sum(p * p, axis=1), 1.0 / (2.0 * np.maximum(along, 2.0 * GRAZING * frame.radius))


def weighted_rows(frame: Frame, blocks: Blocks, sigma: float) -> tuple[Array, Array]:
    """Rows (n, k) and data (n,) of blocks in standard deviations."""
    if isinstance(frame, PlaneFrame):
        N, data, root = plane_rows(frame, blocks)
    else:
        N, data, root = ball_rows(frame, blocks)
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
    origin = blocks.counts @ blocks.points / blocks.counts.sum()
    if rough_normal is None:
        centred = (blocks.points - origin) * np.sqrt(blocks.counts)[:, None]
        rough_normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    frame = PlaneFrame(origin, axes_of(rough_normal))
    for _ in range(2):
        local = (blocks.points - frame.origin) @ frame.axes
        sine = np.maximum(np.abs(blocks.directions @ frame.axes[:, 2]), GRAZING)
        rows = np.stack([local[:, 0], local[:, 1], np.ones(len(local)), local[:, 2]])
        s, t, offset = _least_squares((rows * (blocks.counts / (sine * sine))) @ rows.T)
        frame = PlaneFrame(frame.origin + offset * frame.axes[:, 2], axes_of(frame.axes @ np.array([-s, -t, 1.0])))
    return frame


def _least_squares(G: Array) -> Array:
    """Best unknowns (..., k) by Gram matrices (..., k + 1, k + 1) of weighted rows and data; of those that the rows do
    not tell, nearly the least.
    """
    if G.size == 16:
        return _three_unknowns(G.reshape(4, 4).tolist()).reshape(*G.shape[:-2], 3)
    A, b = G[..., :-1, :-1], G[..., :-1, -1:]
    scale = 1.0 / np.sqrt(np.maximum(np.einsum("...ii->...i", A), 1e-300))[..., None]
    A = A * scale * np.swapaxes(scale, -1, -2)
    A += UNTOLD * np.eye(A.shape[-1])
    return np.asarray((scale * np.linalg.solve(A, scale * b))[..., 0])


def _three_unknowns(G: list[list[float]]) -> Array:
    """The same for one Gram matrix (4, 4), by plain numbers: called often, and numpy is slow with three."""
    (aa, ab, ac, ad), (_, bb, bc, bd), (_, _, cc, cd), _ = G
    p, q, r = (1.0 / math.sqrt(max(of, 1e-300)) for of in (aa, bb, cc))
    aa, bb, cc = aa * p * p + UNTOLD, bb * q * q + UNTOLD, cc * r * r + UNTOLD
    ab, ac, bc = ab * p * q, ac * p * r, bc * q * r
    ad, bd, cd = ad * p, bd * q, cd * r
    x, y, z = solve_three((aa, ab, ac, bb, bc, cc), (ad, bd, cd))
    return np.array([p * x, q * y, r * z])


def axes_of(normal: Array) -> Array:
    """(3, 3) columns s (level, or x where the normal is steep), t and the unit normal."""
    x, y, z = (normal / math.sqrt(normal @ normal)).tolist()
    # By plain numbers: called often, and numpy is slow with three.
    a, b, c = (-y, x, 0.0) if math.hypot(x, y) > 0.5 else (1.0, 0.0, 0.0)
    along = a * x + b * y + c * z
    a, b, c = a - along * x, b - along * y, c - along * z
    length = math.sqrt(a * a + b * b + c * c)
    a, b, c = a / length, b / length, c / length
    return np.array([[a, y * c - z * b, x], [b, z * a - x * c, y], [c, x * b - y * a, z]])


def fit_cylinder_frame(blocks: Blocks) -> CylinderFrame | None:
    """Vertical cylinder through blocks; None where they lie on no circle."""
    circle = _circles(blocks.points.T[None, :2], blocks.directions.T[None, :2], blocks.counts, 4)
    return CylinderFrame(circle.centre[0], float(circle.radius[0])) if circle.good[0] else None


class _Circles(NamedTuple):
    """Circles through k times the same n points: centre (k, 2), radius (k,), good (k,): the others lie on none."""

    centre: Array
    radius: Array
    good: NDArray[np.bool_]


def _circles(points: Array, directions: Array, counts: Array, steps: int) -> _Circles:
    """Circles through points (k, 2, n) in k planes by least squares along the beams (k, 2, n); weights (n,).

    steps : the first regards all beams as steep, the others know their incidence by the circle before.
    """
    middle = points @ counts / counts.sum()
    rows = np.ones((len(points), 4, points.shape[2]))
    np.subtract(points, middle[:, :, None], out=rows[:, :2])
    rows[:, 3] = rows[:, 0] ** 2 + rows[:, 1] ** 2
    # x^2 + y^2 = 2 a x + 2 b y + c about the middle. How the beams cross it is known once there is a circle.
    reach = np.sum(rows[:, :2] * directions, axis=1)
    weight = np.broadcast_to(counts, reach.shape)
    centre, radius, good = np.zeros((len(points), 2)), np.zeros(len(points)), np.ones(len(points), dtype=bool)
    for step in range(steps):
        if step:
            towards = np.sum(centre[:, :, None] * directions, axis=1)
            weight = counts / np.maximum(np.abs(reach - towards), 2.0 * GRAZING * radius[:, None]) ** 2
        x = _least_squares((rows * weight[:, None]) @ np.swapaxes(rows, 1, 2))
        centre = x[:, :2] / 2.0
        square = x[:, 2] + np.sum(centre**2, axis=1)
        good &= (square > LEAST_RADIUS**2) & (square < LARGEST_RADIUS**2)
        radius = np.sqrt(np.clip(square, LEAST_RADIUS**2, LARGEST_RADIUS**2))
    return _Circles(middle + centre, radius, good)


def fit_sphere_frame(blocks: Blocks) -> SphereFrame | None:
    """Sphere through blocks; None where they lie on none."""
    frame, root = SphereFrame(np.average(blocks.points, axis=0, weights=blocks.counts), 1.0), np.sqrt(blocks.counts)
    # How the beams cross it is known once there is a sphere.
    for step in range(SPHERE_STEPS):
        N, data, by_angle = ball_rows(frame, blocks)
        weight = root * by_angle if step else root
        *c, d = np.linalg.lstsq(N * weight[:, None], data * weight, rcond=1e-9)[0].tolist()
        square = d + float(np.dot(c, c))
        if not LEAST_RADIUS**2 < square < LARGEST_SPHERE**2:
            return None
        frame = SphereFrame(frame.centre + np.array(c), float(np.sqrt(square)))
    return frame


def sphere_axes(blocks: Blocks, frame: SphereFrame) -> Array | None:
    """Frame (3, 3) whose third column is the axis from which blocks on a sphere stay away; None where there is none."""
    n = (blocks.points - frame.centre) / frame.radius
    axis = np.linalg.eigh((n * blocks.counts[:, None]).T @ n)[1][:, 0]
    return axes_of(axis) if np.abs(n @ axis).max() < POLAR else None


def turned(blocks: Blocks, axes: Array | None) -> Blocks:
    """Blocks in a frame with columns `axes` (3, 3) in map; None: as they are."""
    return blocks if axes is None else blocks._replace(points=blocks.points @ axes, directions=blocks.directions @ axes)


def fit_axis(blocks: Blocks) -> Array | None:
    """Frame (3, 3) whose third column is the axis of the cylinder through blocks; None where they lie on none.

    Directions all around are tried with a linear fit of the circle across them; from the best ones Gauss and Newton.
    """
    few, blocks = (blocks.pick(np.arange(0, len(blocks.counts), -(-len(blocks.counts) // n))) for n in ENOUGH_BLOCKS)
    frames = np.array([axes_of(axis) for axis in AXES])
    order = np.argsort(_lean(few, frames).misfit, kind="stable")[:BASINS]
    axes, misfit = _followed(few, frames[order], GAINS[0])
    axes, misfit = _followed(blocks, axes[[int(np.argmin(misfit))]], GAINS[1])
    return axes[0] if np.isfinite(misfit[0]) else None


def _followed(blocks: Blocks, axes: Array, gain: float) -> tuple[Array, Array]:
    """The best of the frames (k, 3, 3) to which Gauss and Newton lead from each of `axes`, and its misfit (k,).

    gain : share of the misfit that a step must gain to be followed by another.
    """
    best, least = axes, np.full(len(axes), np.inf)
    for _ in range(TILTS):
        found = _lean(blocks, axes)
        better, gained = found.misfit < least, found.misfit < (1.0 - gain) * least
        best, least = np.where(better[:, None, None], axes, best), np.where(better, found.misfit, least)
        going = gained & (np.abs(found.tilt).max(axis=1) > UPRIGHT)
        if not going.any():
            break
        axes = np.array(
            [axes_of(of @ (*tilt, 1.0)) if go else of for of, tilt, go in zip(axes, found.tilt, going, strict=True)]
        )
    return best, least


class _Lean(NamedTuple):
    """How badly cylinders with given axes fit (k,), inf: not at all; and by how much (k, 2) the axes should lean."""

    misfit: Array
    tilt: Array


def _lean(blocks: Blocks, axes: Array) -> _Lean:
    """The same of axes (k, 3, 3)."""
    turns = np.swapaxes(axes, 1, 2)
    points, across = turns @ blocks.points.T, turns[:, :2] @ blocks.directions.T
    circle = _circles(points[:, :2], across, blocks.counts, 2)
    xy = points[:, :2] - circle.centre[:, :, None]
    distance = np.sqrt(np.sum(xy * xy, axis=1))
    n = xy / np.maximum(distance, 1e-9)[:, None]
    sine = np.abs(np.sum(n * across, axis=1))
    root = np.sqrt(blocks.counts) / np.maximum(sine, GRAZING)
    z = points[:, 2] - points[:, 2].mean(axis=1, keepdims=True)
    miss = distance - circle.radius[:, None]
    rows = np.concatenate([z[:, None] * n, n, np.ones_like(z)[:, None], miss[:, None]], axis=1) * root[:, None]
    G = rows @ np.swapaxes(rows, 1, 2)
    return _Lean(np.where(circle.good, G[:, 5, 5], np.inf), _least_squares(G)[:, :2])
