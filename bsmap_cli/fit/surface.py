"""Surface of a data set: curves along its scan lines, then across them through their control points, Eq. (19-33)."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core import leastsquares
from bsmap_cli.core.bspline import TensorSpline, design_matrix, evaluate_surface
from bsmap_cli.errors import BsmapError
from bsmap_cli.fit.alignment import shared_centripetal
from bsmap_cli.fit.curves import CurveFit, Rows, as_one_row, row_ends
from bsmap_cli.fit.lines import ScanLines
from bsmap_cli.fit.net import Net, columns_of, settled
from bsmap_cli.fit.refinement import Refined, refine_curves
from bsmap_cli.model import Array, Residuals
from bsmap_cli.params import FitParams


class SurfaceFit(NamedTuple):
    """A fitted surface with what its covariance needs.

    blocks : (nu, nv, 6) sensor covariance of each control point.  correlation_u : (nu, nu), correlation_v : (nv, nv).
    u : (n,) parameters of the data points.  v : (lines,) parameters of the scan lines.
    error_u, error_v : metres, largest errors of the curves along and across the scan lines, beyond their allowance.
    """

    spline: TensorSpline
    blocks: Array
    correlation_u: Array
    correlation_v: Array
    u: Array
    v: Array
    residuals: Residuals
    error_u: float
    error_v: float


def fit_scan_lines(lines: ScanLines, params: FitParams, u: Array | None = None) -> SurfaceFit:
    """Fit one surface to scan lines, the paper's way.

    The degree across is lowered where there are not scan lines enough for it.

    Parameters
    ----------
    u : (n,) parameters of the points, from 0 to 1 in each line, that stay as they are; by default those that the
        beams share, aligned with the curves.

    Raises
    ------
    BsmapError
        With less than two scan lines, or a line of less than degree_u + 1 points.
    """
    if lines.n_lines < 2:
        raise BsmapError(f"a surface needs 2 scan lines, here is {lines.n_lines}")
    degree_u, degree_v = params.degree_u, min(params.degree_v, lines.n_lines - 1)
    net = settled(_fit_net(lines, params, degree_v, u), params.bound_u, params.bound_v)
    spline, across, v = net.spline, net.across.fit, net.across.rows.u
    u = np.resize(net.along.rows.u, len(lines.points))
    line_blocks, correlation_u = _propagate_along(lines, net.along, degree_u)
    distances = np.linalg.norm(evaluate_surface(spline, u, v[lines.line]) - lines.points, axis=1)
    blocks, correlation_v = _propagate_across(line_blocks, v, across, degree_v)
    error_u, error_v = (max(0.0, float(found.excess.max())) for found in (net.along, net.across))
    return SurfaceFit(spline, blocks, correlation_u, correlation_v, u, v, residuals_of(distances), error_u, error_v)


def _fit_net(lines: ScanLines, params: FitParams, degree_v: int, u: Array | None) -> Net:
    place = lines.beam if u is None else None
    if u is None:
        u = shared_centripetal(lines.points, lines.line, lines.beam)
    rows = Rows(u, lines.line, lines.points[:, None], _allowance(lines.covariances, params)[:, None], place)
    along = refine_curves(as_one_row(rows), params.degree_u, params.bound_u, params.knots_per_pass)
    blocks = _propagate_along(lines, along, params.degree_u)[0]
    columns, order = columns_of(along.fit), np.arange(lines.n_lines)
    row = Rows(mean_centripetal(columns), np.zeros_like(order), columns, _allowance(blocks, params), order)
    across = refine_curves(row, degree_v, params.bound_v, params.knots_per_pass)
    return Net(along, across, params.degree_u, degree_v)


def _allowance(covariances: Array, params: FitParams) -> Array:
    """Errors (...) in metres that the sensor's noise explains, of packed covariances (..., 6)."""
    return params.noise_margin * np.sqrt(covariances[..., [0, 3, 5]].sum(axis=-1))


def mean_centripetal(columns: Array) -> Array:
    """Common parameters (lines,) of columns (lines, k, 3): centripetal ones of each column, averaged over the columns.

    Columns that do not move (the pole of a rotation) say nothing and do not count.
    """
    steps = np.sqrt(np.linalg.norm(np.diff(columns, axis=0), axis=2))
    totals = steps.sum(axis=0)
    moving = totals > 1e-6
    if not moving.any():
        return np.linspace(0.0, 1.0, len(columns))
    v = np.concatenate([[0.0], np.cumsum((steps[:, moving] / totals[moving]).mean(axis=1))])
    v /= v[-1]
    return v


def _propagate_along(lines: ScanLines, along: Refined, degree: int) -> tuple[Array, Array]:
    """C_P = A C_Q A' along the scan lines, Eq. (32): blocks (lines, nu, 6), mean correlation (nu, nu).

    A = (N'N)^-1 N'; under equal noise A A' = (N'N)^-1, which gives the correlation.
    """
    knots, factor, rows = along.fit.knots, along.fit.factor, along.rows
    n_control = len(knots) - degree - 1
    blocks = np.empty((lines.n_lines, n_control, 6))
    correlation = np.zeros((rows.n_rows, n_control, n_control))
    starts = np.searchsorted(lines.line, np.arange(lines.n_lines + 1))
    for k, (first, last) in enumerate(zip(*row_ends(rows.row), strict=True)):
        of_row = factor[:, k * n_control : (k + 1) * n_control]
        A = leastsquares.solve(of_row, design_matrix(knots, degree, rows.u[first : last + 1]).T)
        for line in range(lines.n_lines) if rows.n_rows == 1 else (k,):
            blocks[line] = A**2 @ lines.covariances[starts[line] : starts[line + 1]]
        correlation[k] = _correlation(leastsquares.solve(of_row, np.eye(n_control)))
    return blocks, correlation.mean(axis=0)


def _propagate_across(blocks: Array, v: Array, across: CurveFit, degree: int) -> tuple[Array, Array]:
    """C_P = A C A' across the scan lines, Eq. (33): blocks (nu, nv, 6), correlation (nv, nv).

    Exact for the blocks: the lines' sensor noise is independent.
    """
    A = leastsquares.solve(across.factor, design_matrix(across.knots, degree, v).T)
    return np.einsum("jl,lik->ijk", A**2, blocks), _correlation(A @ A.T)


def _correlation(covariance: Array) -> Array:
    scale = 1.0 / np.sqrt(np.diag(covariance))
    return (covariance + covariance.T) / 2 * scale[:, None] * scale


def residuals_of(distances: Array) -> Residuals:
    """Statistics of distances (n,), metres."""
    return Residuals(
        points=len(distances),
        mean=float(distances.mean()),
        rms=float(np.sqrt(np.mean(distances**2))),
        percentile_95=float(np.percentile(distances, 95)),
        maximum=float(distances.max()),
    )
