"""B-spline surface in map of a fitted height field, with the covariance of its heights."""

import numpy as np

from bsmap_cli.core.bspline import TensorSpline, clamped_knots, design_matrix, inner_knots
from bsmap_cli.fit.heights import POLAR, CylinderBase, HeightField, Knots, PlaneBase, greville
from bsmap_cli.fit.selection import Fitted
from bsmap_cli.model import Array, HeightCovariance, PosePart

WIDEST_ARC = 0.7
"""Radians of a cylinder that one cubic span follows."""
ARC_ERROR = 2e-4
"""Metres by which cubic spans may leave a cylinder, by a bound that least squares stays well below."""


def spline_of(fitted: Fitted, pose: tuple[PosePart, ...]) -> tuple[TensorSpline, HeightCovariance]:
    """Surface in map with its covariance."""
    return spline_over(fitted.field, _inverse(fitted.information), pose)


def spline_over(field: HeightField, matrix: Array, pose: tuple[PosePart, ...]) -> tuple[TensorSpline, HeightCovariance]:
    """Surface in map of a height field whose heights have the covariance `matrix` (k, k).

    A height field over a plane is a B-spline surface as it stands. One over a cylinder is approximated by a spline that
    is cubic around the axis.
    """
    if isinstance(field.base, PlaneBase):
        k = field.knots
        points = field.base.place(_net(field, field.heights))
        covariance = HeightCovariance(field.base.axes[None, None, :, 2], matrix, pose)
        return TensorSpline(k.degree_s, k.degree_t, k.s, k.t, points), covariance
    return _over_cylinder(field, field.base, matrix, pose)


def _net(field: HeightField, heights: Array) -> Array:
    """(ns, nt, 3) s, t, h of the control points: s and t at the Greville abscissae."""
    k = field.knots
    s, t = greville(k.s, k.degree_s), greville(k.t, k.degree_t)
    out = np.empty((*k.shape, 3))
    out[..., 0] = (field.low[0] + s * (field.high[0] - field.low[0]))[:, None]
    out[..., 1] = field.low[1] + t * (field.high[1] - field.low[1])
    out[..., 2] = heights
    return out


def _inverse(information: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information * scale[:, None] * scale)
    inverse = inverse * scale[:, None] * scale
    return (inverse + inverse.T) / 2.0


def _over_cylinder(
    field: HeightField, base: CylinderBase, matrix: Array, pose: tuple[PosePart, ...]
) -> tuple[TensorSpline, HeightCovariance]:
    """Cubic around, by least squares through the height field, and exact upwards, unless the base bulges.

    The control points depend linearly on the heights: what they move outwards gives the covariance.
    """
    knots = _cubic_around(field, base)
    u = np.linspace(0.0, 1.0, 20 * knots.shape[0])
    around = design_matrix(field.knots.s, field.knots.degree_s, u)
    v, upwards, solve_t = _along_axis(field, base, knots)
    net = np.empty((len(u), len(v), 3))
    net[..., 0] = (field.low[0] + u * (field.high[0] - field.low[0]))[:, None]
    net[..., 1] = field.low[1] + v * (field.high[1] - field.low[1])
    net[..., 2] = around @ field.heights @ upwards.T
    if base.bulge is not None:
        net[..., 2] += base.bulge.over(net[0, :, 1])[0]
    solve = np.linalg.pinv(design_matrix(knots.s, knots.degree_s, u))  # (ns, k)
    points = np.asarray(np.einsum("iu,uvx,jv->ijx", solve, base.place(net), solve_t, optimize=True))
    outwards, directions = (_outwards(field, base, at) for at in (u, greville(knots.s, knots.degree_s)))
    by_heights = (solve * (directions @ outwards.T)) @ around
    M = np.kron(by_heights, solve_t @ upwards)
    covariance = HeightCovariance(directions[:, None], M @ matrix @ M.T, pose)
    return TensorSpline(knots.degree_s, knots.degree_t, knots.s, knots.t, points), covariance


def _along_axis(field: HeightField, base: CylinderBase, knots: Knots) -> tuple[Array, Array, Array]:
    """Places (k,) along the axis, basis functions there of the field, and what takes values there to control points."""
    if base.bulge is None:
        one = np.eye(knots.shape[1])
        return greville(knots.t, knots.degree_t), one, one
    v = np.linspace(0.0, 1.0, 20 * knots.shape[1])
    upwards = design_matrix(field.knots.t, field.knots.degree_t, v)
    return v, upwards, np.asarray(np.linalg.pinv(design_matrix(knots.t, knots.degree_t, v)), dtype=np.float64)


def _outwards(field: HeightField, base: CylinderBase, u: Array) -> Array:
    """(n, 3) unit vectors away from the axis at parameters u (n,)."""
    return base.outwards(base.middle + (field.low[0] + u * (field.high[0] - field.low[0])) / base.radius)


def _cubic_around(field: HeightField, base: CylinderBase) -> Knots:
    """Knots that follow the arc, and along the axis, too, where the base bulges."""
    k, bulge = field.knots, base.bulge
    angles = _angles(field.low[0] / base.radius, field.high[0] / base.radius, base.radius)
    s = _cubic(k.s, k.degree_s, (angles * base.radius - field.low[0]) / (field.high[0] - field.low[0]))
    if bulge is None:
        return Knots(3, k.degree_t, s, k.t)
    ends = np.arcsin(np.clip((np.array([field.low[1], field.high[1]]) - bulge.middle) / bulge.radius, -POLAR, POLAR))
    places = bulge.middle + bulge.radius * np.sin(_angles(ends[0], ends[1], bulge.radius))
    return Knots(3, 3, s, _cubic(k.t, k.degree_t, (places - field.low[1]) / (field.high[1] - field.low[1])))


def _angles(first: float, last: float, radius: float) -> Array:
    """(k,) between the first and the last, so that cubic spans follow the arc: one of angle a leaves it by about
    a^4 / 384 of the radius.
    """
    widest = min(WIDEST_ARC, (384.0 * ARC_ERROR / radius) ** 0.25)
    return np.linspace(first, last, max(1, int(np.ceil((last - first) / widest))) + 1)[1:-1]


def _cubic(knots: Array, degree: int, more: Array) -> Array:
    """Cubic knots at the inner ones of others and at more places (k,)."""
    return clamped_knots(3, np.union1d(np.round(inner_knots(knots, degree), 10), np.round(more, 10)))
