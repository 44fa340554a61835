"""Covariance of a B-spline surface from that of its control points, Eq. (33) and (37)."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from bsmap_cli.core.bspline import basis_functions, design_matrix, evaluate_surface
from bsmap_cli.core.gaussian import symmetric_sqrt, unpack
from bsmap_cli.model import Array, BSplineSurface, HeightCovariance, PosePart, SurfaceCovariance

CHUNK = 2048
TWIST = np.array([1.0, -1.0, -1.0, 1.0])
"""Of the four heights of a bilinear patch, row by row, what makes it no plane."""
FROM_THREE = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 1.0, 1.0]])
"""The four heights of a plane by the first three."""
FLAT = 1e-8
"""Metres of twist below which heights are those of a plane."""


def is_plane(covariance: Array) -> bool:
    """Whether heights with a covariance (n, n) are the four of a bilinear patch that is a plane for certain."""
    return len(covariance) == 4 and bool(TWIST @ covariance @ TWIST < FLAT**2)


def with_twist(covariance: Array) -> Array:
    """Covariance (4, 4) of the heights of a plane as if they had been fitted without knowing that it is one.

    With s and t from -1 to 1 heights are a + b s + c t + d (s - s0) (t - t0), where a + b s0 + c t0 has the least
    variance. Of data whose density is a product of one in s and one in t, the variance of d is that of b times that of
    c over the least one, and d has nothing in common with the others.
    """
    s, t = np.array([-1.0, -1.0, 1.0, 1.0]), np.array([-1.0, 1.0, -1.0, 1.0])
    G = np.stack([np.ones(4), s, t]) / 4.0
    K = G @ covariance @ G.T
    middle = -np.linalg.solve(K[1:, 1:], K[1:, 0])
    least = K[0, 0] + K[0, 1:] @ middle
    shape = (s - middle[0]) * (t - middle[1])
    return np.asarray(covariance + K[1, 1] * K[2, 2] / least * np.outer(shape, shape))


def pose_covariance(pose: Sequence[PosePart], points: Array) -> Array:
    """Covariance (..., 3, 3) in map that points (..., 3) have from the pose parts of their surface.

    sum w^2 J C J' with J = [[1, 0, -(y - c_y)], [0, 1, x - c_x], [0, 0, 0]], for the shares of the data sets are
    weighted means, and of what the data sets of a trajectory have in common (sum w J M) (sum w J M)'.
    """
    total = np.zeros((*points.shape, 3))
    common: dict[str, Array] = {}
    for part in pose:
        J = np.zeros((*points.shape, 3))
        J[..., 0, 0] = J[..., 1, 1] = part.weight
        J[..., 0, 2] = part.weight * (part.centre[1] - points[..., 1])
        J[..., 1, 2] = part.weight * (points[..., 0] - part.centre[0])
        total += J @ part.own @ np.swapaxes(J, -1, -2)
        if part.modes is not None:
            moved = J @ part.modes
            common[part.trajectory] = common[part.trajectory] + moved if part.trajectory in common else moved
    for moved in common.values():
        total += moved @ np.swapaxes(moved, -1, -2)
    return total


def pose_difference(first: Sequence[PosePart], second: Sequence[PosePart]) -> tuple[PosePart, ...]:
    """Pose parts of the difference of two surfaces' points: what both have of a data set is taken off each other."""
    parts = {part.data_set: part for part in first}
    for part in second:
        before = parts[part.data_set].weight if part.data_set in parts else 0.0
        parts[part.data_set] = replace(part, weight=before - part.weight)
    return tuple(parts.values())


def sensor_covariance(surface: BSplineSurface, u: ArrayLike, v: ArrayLike) -> Array:
    """Sensor part B C_P B' of the covariance (n, 3, 3) at scattered parameters u, v (n,), Eq. (37)."""
    u, v = np.asarray(u, dtype=float), np.asarray(v, dtype=float)
    covariance = surface.covariance
    result = np.empty((len(u), 3, 3))
    roots = np.zeros(0) if isinstance(covariance, HeightCovariance) else symmetric_sqrt(unpack(covariance.blocks))
    for start in range(0, len(u), CHUNK):
        part = slice(start, start + CHUNK)
        if isinstance(covariance, HeightCovariance):
            result[part] = _heights_chunk(surface, covariance, u[part], v[part])
        else:
            result[part] = _sensor_chunk(surface, covariance, roots, u[part], v[part])
    return result


def _heights_chunk(surface: BSplineSurface, covariance: HeightCovariance, u: Array, v: Array) -> Array:
    """G M G' with column (i, j) of G being N_i N_j d_ij."""
    along_u = design_matrix(surface.knots_u, surface.degree_u, u)
    along_v = design_matrix(surface.knots_v, surface.degree_v, v)
    directions = np.broadcast_to(covariance.directions, surface.control_points.shape)
    G = np.einsum("ni,nj,ijk->nkij", along_u, along_v, directions, optimize=True).reshape(len(u), 3, -1)
    return np.asarray((G @ covariance.matrix) @ np.swapaxes(G, 1, 2))


def _sensor_chunk(surface: BSplineSurface, covariance: SurfaceCovariance, roots: Array, u: Array, v: Array) -> Array:
    """sum over local i, j, k, l of  M_ij rho_u[i, k] rho_v[j, l] M_kl'  with  M_ij = N_i N_j L_ij."""
    first_u, basis_u = basis_functions(surface.knots_u, surface.degree_u, u)
    first_v, basis_v = basis_functions(surface.knots_v, surface.degree_v, v)
    i = first_u[:, None] + np.arange(surface.degree_u + 1)
    j = first_v[:, None] + np.arange(surface.degree_v + 1)
    rho_u = covariance.correlation_u[i[:, :, None], i[:, None, :]]
    rho_v = covariance.correlation_v[j[:, :, None], j[:, None, :]]
    weights = basis_u[:, 0, :, None] * basis_v[:, 0, None, :]
    M = weights[..., None, None] * roots[i[:, :, None], j[:, None, :]]
    n, k, m = weights.shape
    spread = (rho_u @ M.reshape(n, k, -1)).reshape(n, k, m, 9)
    spread = (rho_v[:, None] @ spread).reshape(n, k * m, 3, 3)
    return np.einsum("nkab,nkcb->nac", M.reshape(n, k * m, 3, 3), spread)


def surface_covariance(surface: BSplineSurface, u: ArrayLike, v: ArrayLike) -> Array:
    """Covariance (n, 3, 3) in map of the surface's points at scattered parameters: sensor and pose part, Eq. (37)."""
    return sensor_covariance(surface, u, v) + pose_covariance(surface.covariance.pose, evaluate_surface(surface, u, v))


def control_point_covariances(surface: BSplineSurface) -> Array:
    """Covariance (nu, nv, 3, 3) in map of each control point, sensor and pose part, Eq. (33)."""
    covariance = surface.covariance
    if isinstance(covariance, HeightCovariance):
        directions = np.broadcast_to(covariance.directions, surface.control_points.shape)
        variances = np.diag(covariance.matrix).reshape(surface.control_points.shape[:2])
        blocks = variances[..., None, None] * directions[..., :, None] * directions[..., None, :]
    else:
        blocks = unpack(covariance.blocks)
    return blocks + pose_covariance(surface.covariance.pose, surface.control_points)
