"""One surface fitted to the merged samples of two patches, section 7, with their covariance carried, Eq. (32-33)."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core import leastsquares
from bsmap_cli.core.bspline import TensorSpline, design_matrix, evaluate_grid
from bsmap_cli.fit.curves import CurveFit, Rows, fit_curves
from bsmap_cli.fit.refinement import refine_curves
from bsmap_cli.fit.surface import residuals_of
from bsmap_cli.merge.covariance import carry
from bsmap_cli.merge.fusion import Fused, Pairing
from bsmap_cli.model import Array, BSplineSurface, Residuals, SurfaceCovariance
from bsmap_cli.params import MergeParams

KNOTS_PER_PASS = 4


class Refit(NamedTuple):
    """The fitted surface, its covariance, and the distances of the samples to it."""

    spline: TensorSpline
    covariance: SurfaceCovariance
    residuals: Residuals


def refit(surface: BSplineSurface, pairing: Pairing, fused: Fused, params: MergeParams) -> Refit:
    """Fit the merged samples of a patch, first along u, then along v, on as few knots as the bounds ask for."""
    p, q = surface.degree_u, surface.degree_v
    n, m = fused.points.shape[:2]
    along = _fit(pairing.u, fused.points, surface.knots_u, p, params.bound_u)
    columns = np.swapaxes(along.control_points[0], 0, 1)
    across = _fit(pairing.v, columns, surface.knots_v, q, params.bound_v)
    spline = TensorSpline(p, q, along.knots, across.knots, np.swapaxes(across.control_points[0], 0, 1))
    distances = np.linalg.norm(evaluate_grid(spline, pairing.u, pairing.v) - fused.points, axis=2)
    covariance = carry(fused.covariance, _projector(along, p, pairing.u), _projector(across, q, pairing.v))
    return Refit(spline, covariance, residuals_of(distances.reshape(n * m)))


def _fit(parameters: Array, data: Array, knots: Array, degree: int, bound: float) -> CurveFit:
    """Curves through data (n, k, 3) on a common knot vector within `bound`.

    The patch's own knots are taken where the bound asks for as many: on them all that was not moved comes back exactly.
    """
    rows = Rows(parameters, np.zeros(len(data), dtype=np.int64), data, np.zeros(data.shape[:2]))
    fit = refine_curves(rows, degree, bound, KNOTS_PER_PASS).fit
    return fit if len(fit.knots) < len(knots) else fit_curves(rows, knots, degree)


def _projector(fit: CurveFit, degree: int, parameters: Array) -> Array:
    """A = (N'N)^-1 N', (n_control, n), from data at parameters (n,) to control points, Eq. (32)."""
    return leastsquares.solve(fit.factor, design_matrix(fit.knots, degree, parameters).T)
