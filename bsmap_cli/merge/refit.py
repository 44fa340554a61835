"""One surface fitted to the merged samples of two patches, section 7, with their covariance carried, Eq. (32-33)."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core import leastsquares
from bsmap_cli.core.bspline import TensorSpline, basis_functions, evaluate_grid
from bsmap_cli.merge.covariance import carry
from bsmap_cli.merge.fusion import Fused, Pairing
from bsmap_cli.model import Array, BSplineSurface, Residuals, SurfaceCovariance


class Refit(NamedTuple):
    """Control points (nu, nv, 3) on knots, their covariance, and the distances of the samples to the surface."""

    knots_u: Array
    knots_v: Array
    control_points: Array
    covariance: SurfaceCovariance
    residuals: Residuals


def refit(surface: BSplineSurface, pairing: Pairing, fused: Fused) -> Refit:
    """Fit the merged samples on the knots of the patch that was sampled.

    On these knots all that was not moved comes back as it was, to rounding; fewer knots would lose shape with each
    merging, and more have nothing to follow, for the shift between two surfaces is smoother than the surfaces.
    """
    A_u = _least_squares(surface.knots_u, surface.degree_u, pairing.u)
    A_v = _least_squares(surface.knots_v, surface.degree_v, pairing.v)
    control_points = np.einsum("ia,jb,abk->ijk", A_u, A_v, fused.points, optimize=True)
    spline = TensorSpline(surface.degree_u, surface.degree_v, surface.knots_u, surface.knots_v, control_points)
    fitted = evaluate_grid(spline, pairing.u, pairing.v)
    distances = np.linalg.norm(fitted - fused.points, axis=2).ravel()
    covariance = carry(fused.covariance, A_u, A_v)
    return Refit(surface.knots_u, surface.knots_v, control_points, covariance, residuals_of(distances))


def _least_squares(knots: Array, degree: int, parameters: Array) -> Array:
    """A = (N'N)^-1 N', (n_control, n), from data at parameters (n,) to control points, Eq. (32)."""
    first, values = basis_functions(knots, degree, parameters)
    return leastsquares.fit(first, values[:, 0], np.eye(len(parameters)), len(knots) - degree - 1)[0]


def residuals_of(distances: Array) -> Residuals:
    """Residual statistics of distances (n,) in metres."""
    return Residuals(
        points=len(distances),
        mean=float(distances.mean()),
        rms=float(np.sqrt(np.mean(distances**2))),
        percentile_95=float(np.percentile(distances, 95)),
        maximum=float(distances.max()),
    )
