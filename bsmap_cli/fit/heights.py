"""Height fields over a base, fitted along the beams: h(s, t), a tensor-product spline, over a plane or a cylinder.

The noise lies along the beam, so the residual is measured along it and the parameters are those of the beam's foot on
the model, not of the noisy point. One Gauss-Newton step is a linear least-squares problem in the heights.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import TensorSpline, clamped_knots, design_matrix, inner_knots, open_knots
from bsmap_cli.core.pieces import Pieces, evaluate_pieces, polynomial_pieces
from bsmap_cli.fit.lowmodels import axes_of
from bsmap_cli.model import Array

POLAR = 0.98
"""Sine of the latitude to which heights follow a sphere over the cylinder around it."""


def _turned(vectors: Array, axes: Array) -> Array:
    """Vectors (..., 3) in axes (3, 3); of a plain list, columns in one piece: long operations on them are quick."""
    return (axes.T @ vectors.T).T if vectors.ndim == 2 else vectors @ axes


def _columns(*columns: Array) -> Array:
    """(n, k) of k columns (n,), each in one piece: long operations on them are quick."""
    return np.array(columns).T


class PlaneBase(NamedTuple):
    """origin (3,), axes (3, 3) in map: columns along s, along t, normal."""

    origin: Array
    axes: Array

    def local(self, points: Array) -> Array:
        """(..., 3) s, t, h of points (..., 3)."""
        return _turned(points - self.origin, self.axes)

    def normal(self, local: Array, gradient: Array) -> Array:
        """(n, 3) gradient in map of the height above a field whose own is (n, 2) at places `local` (n, 3)."""
        s, t, h = self.axes.T
        return h - gradient[:, :1] * s - gradient[:, 1:] * t

    def place(self, local: Array) -> Array:
        """Points (..., 3) in map of s, t, h (..., 3)."""
        return self.origin + local @ self.axes.T


class Bulge(NamedTuple):
    """A sphere over the cylinder around it: t of its centre and its radius, metres."""

    middle: float
    radius: float

    def over(self, t: Array) -> tuple[Array, Array]:
        """Heights (n,) at t (n,) and their slopes; near the poles and beyond, the sphere goes on straight."""
        return bulge_over(self.radius, t - self.middle)


def bulge_over(radius: Array | float, way: Array) -> tuple[Array, Array]:
    """Heights (n,) of spheres over the cylinders around them and their slopes, `way` (n,) along the axis."""
    inside = np.clip(way, -POLAR * radius, POLAR * radius)
    level = np.sqrt(radius**2 - inside**2)
    slope = -inside / level
    return level - radius + slope * (way - inside), slope


class CylinderBase(NamedTuple):
    """Cylinder: s is the arc's length from the angle `middle`, t the way along the axis, h the distance outwards.

    upright : (3, 3) columns x, y and along the axis, of the frame in which the cylinder is vertical; None: that is map.
    bulge : of the sphere that the cylinder goes around; heights of a field are then those beyond the sphere.
    """

    centre: Array
    radius: float
    middle: float
    upright: Array | None = None
    bulge: Bulge | None = None

    def local(self, points: Array) -> Array:
        points = self._own(points)
        x, y = points[..., 0] - self.centre[0], points[..., 1] - self.centre[1]
        angle = (np.arctan2(y, x) - self.middle + np.pi) % (2.0 * np.pi) - np.pi
        return np.stack([angle * self.radius, points[..., 2], np.hypot(x, y) - self.radius], axis=-1)

    def normal(self, local: Array, gradient: Array) -> Array:
        angle = local[:, 0] / self.radius + self.middle
        c, s = np.cos(angle), np.sin(angle)
        around = gradient[:, 0] * self.radius / np.maximum(self.radius + local[:, 2], 0.1 * self.radius)
        return self._in_map(_columns(c + around * s, s - around * c, -gradient[:, 1]))

    def place(self, local: Array) -> Array:
        angle, distance = local[..., 0] / self.radius + self.middle, self.radius + local[..., 2]
        x, y = self.centre[0] + distance * np.cos(angle), self.centre[1] + distance * np.sin(angle)
        return self._in_map(np.stack([x, y, local[..., 1]], axis=-1))

    def outwards(self, angle: Array) -> Array:
        """(n, 3) unit vectors away from the axis at angles (n,)."""
        return self._in_map(np.stack([np.cos(angle), np.sin(angle), np.zeros(len(angle))], axis=-1))

    def _own(self, vectors: Array) -> Array:
        return vectors if self.upright is None else _turned(vectors, self.upright)

    def _in_map(self, vectors: Array) -> Array:
        return vectors if self.upright is None else _turned(vectors, self.upright.T)


Base = PlaneBase | CylinderBase


def bulge_of(base: Base) -> Bulge | None:
    """The sphere that the heights of a field begin from, if it is one."""
    return None if isinstance(base, PlaneBase) else base.bulge


class Knots(NamedTuple):
    """Degrees and clamped knots on [0, 1] of a height field."""

    degree_s: int
    degree_t: int
    s: Array
    t: Array

    @property
    def shape(self) -> tuple[int, int]:
        """Control points along s and t."""
        return len(self.s) - self.degree_s - 1, len(self.t) - self.degree_t - 1

    @property
    def size(self) -> int:
        """Number of control points."""
        return self.shape[0] * self.shape[1]


@lru_cache(maxsize=1)
def flat_knots() -> Knots:
    """The least surface: bilinear, without inner knots."""
    knots = open_knots(1)
    knots.flags.writeable = False
    return Knots(1, 1, knots, knots)


def least_knots(base: Base, low: Array, high: Array) -> Knots:
    """Knots of the least surface that can bear what the base took from the data, on the rectangle from low to high.

    A plane's offset and slopes are those of a bilinear surface. A cylinder's radius and centre are heights that go like
    1, sine and cosine around it: without a second degree, and a span for each half turn, the covariance would know
    nothing of the last. Of a sphere they are curves along the axis, too.
    """
    flat = flat_knots()
    if isinstance(base, PlaneBase):
        return flat
    spans = int(np.ceil((high[0] - low[0]) / (np.pi * base.radius)))
    around = flat._replace(degree_s=2, s=clamped_knots(2, np.arange(1, spans) / spans))
    return around if base.bulge is None else around._replace(degree_t=2, t=open_knots(2))


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights over a base on the rectangle from `low` (2,) to `high` (2,) in s and t, metres; heights (ns, nt).

    Where the base bulges, they are told from the bulge on.
    """

    base: Base
    low: Array
    high: Array
    knots: Knots
    heights: Array

    def parameters(self, local: Array) -> Array:
        """(n, 2) u, v in [0, 1] inside the rectangle, beyond it outside, of s, t, h (n, 3)."""
        return _columns(*((local[:, k] - self.low[k]) / (self.high[k] - self.low[k]) for k in (0, 1)))

    @cached_property
    def pieces(self) -> Pieces:
        """Polynomials of the heights, prepared once for all evaluations."""
        k = self.knots
        return polynomial_pieces(TensorSpline(k.degree_s, k.degree_t, k.s, k.t, self.heights[:, :, None]))


def evaluate(field: HeightField, uv: Array) -> tuple[Array, Array]:
    """Heights (n,) and their gradients (n, 2) by s and t; beyond the rectangle the surface goes on straight."""
    height, gradient = _bilinear(field, uv) if field.knots.shape == (2, 2) else _spline(field, uv)
    bulge = bulge_of(field.base)
    if bulge is not None:
        more, slope = bulge.over(field.low[1] + uv[:, 1] * (field.high[1] - field.low[1]))
        height, gradient[:, 1] = height + more, gradient[:, 1] + slope
    return height, gradient


def _spline(field: HeightField, uv: Array) -> tuple[Array, Array]:
    inside = np.clip(uv, 0.0, 1.0)
    value, by_u, by_v = evaluate_pieces(field.pieces, inside[:, 0], inside[:, 1], 1)[:, 0]
    height = value + by_u * (uv[:, 0] - inside[:, 0]) + by_v * (uv[:, 1] - inside[:, 1])
    size = field.high - field.low
    return height, _columns(by_u / size[0], by_v / size[1])


def _bilinear(field: HeightField, uv: Array) -> tuple[Array, Array]:
    """The same for the least surface, whose formula holds beyond the rectangle, too."""
    (a, b), (c, d) = field.heights
    u, v = uv[:, 0], uv[:, 1]
    twist = a - b - c + d
    size = field.high - field.low
    gradient = _columns((c - a + twist * v) / size[0], (b - a + twist * u) / size[1])
    return a + (c - a) * u + (b - a) * v + twist * u * v, gradient


def offset(field: HeightField, points: Array) -> tuple[Array, Array]:
    """Heights (n,) of points (n, 3) above the field, to first order their distances, and unit normals (n, 3) there."""
    local = field.base.local(points)
    height, gradient = evaluate(field, field.parameters(local))
    slope = field.base.normal(local, gradient)
    length = np.sqrt(np.sum(slope**2, axis=1))
    return (local[:, 2] - height) / length, slope / length[:, None]


def plane_base(points: Array, normal: Array) -> PlaneBase:
    """Plane base at the middle of points (n, 3), its axes turned to the smallest rectangle around them, or level."""
    origin = points.mean(axis=0)
    axes = axes_of(normal)
    flat = (points - origin) @ axes[:, :2]
    angles = np.radians(np.arange(0.0, 90.0, 3.0))
    ways = np.stack([np.cos(angles), np.sin(angles)])
    areas = np.ptp(ways.T @ flat.T, axis=1) * np.ptp(np.stack([-ways[1], ways[0]]).T @ flat.T, axis=1)
    # Walls stay level unless another rectangle is much smaller.
    best = int(np.argmin(areas))
    if abs(axes[2, 2]) < 0.9 and areas[best] > 0.8 * areas[0]:
        best = 0
    c, s = np.cos(angles[best]), np.sin(angles[best])
    return PlaneBase(origin, axes @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]))


def basis_matrix(knots: Knots, uv: Array) -> Array:
    """(n, ns * nt) products of the basis functions at parameters (n, 2), clamped to [0, 1]."""
    inside = np.clip(uv, 0.0, 1.0)
    if knots.size == 4:
        u, v = inside.T
        return _columns((1.0 - u) * (1.0 - v), (1.0 - u) * v, u * (1.0 - v), u * v)
    along_s = design_matrix(knots.s, knots.degree_s, inside[:, 0])
    along_t = design_matrix(knots.t, knots.degree_t, inside[:, 1])
    return (along_s[:, :, None] * along_t[:, None, :]).reshape(len(uv), -1)


def greville(knots: Array, degree: int) -> Array:
    """(n,) parameters at which control points of a straight line lie evenly with it."""
    return np.array([knots[i + 1 : i + 1 + degree].mean() for i in range(len(knots) - degree - 1)])


def with_degree(knots: Array, degree: int) -> Array:
    """Clamped knots of one degree more, the inner ones as often as before: smoother than raising it exactly."""
    return clamped_knots(degree + 1, inner_knots(knots, degree))


def with_knot(knots: Array, degree: int, new: float) -> Array:
    """Clamped knots with one more."""
    return clamped_knots(degree, np.append(inner_knots(knots, degree), new))
