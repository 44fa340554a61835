"""Curves along and across the scan lines, which make a surface, and the last moves of its parameters."""

from typing import NamedTuple

import numpy as np

from bsmap_cli.core.bspline import TensorSpline
from bsmap_cli.errors import BsmapError
from bsmap_cli.fit.alignment import common_steps, moved
from bsmap_cli.fit.curves import CurveFit, evaluate_rows, fit_curves
from bsmap_cli.fit.refinement import Refined
from bsmap_cli.model import Array

SETTLING = 30
"""Moves of all parameters on the finished surface."""


class Net(NamedTuple):
    """Curves along the scan lines, of a single row where all lines share their parameters, and those across them."""

    along: Refined
    across: Refined
    degree_u: int
    degree_v: int

    @property
    def spline(self) -> TensorSpline:
        """The surface."""
        control_points = np.swapaxes(self.across.fit.control_points[0], 0, 1)
        return TensorSpline(self.degree_u, self.degree_v, self.along.fit.knots, self.across.fit.knots, control_points)

    def at_points(self, order_u: int, order_v: int) -> Array:
        """Points of the surface at the parameters of the data, laid out as these, or derivatives."""
        along, across = self.along, self.across
        columns = evaluate_rows(across.rows, across.fit.knots, self.degree_v, across.fit.control_points, order_v)
        of_lines = columns[:, :, None] if along.rows.n_rows > 1 else np.swapaxes(columns, 0, 1)[None]
        return evaluate_rows(along.rows, along.fit.knots, self.degree_u, of_lines, order_u)


def columns_of(fit: CurveFit) -> Array:
    """Control points (lines, n_control, 3) of curves of one line a row, or of all lines in one row."""
    control_points = fit.control_points
    return control_points[:, :, 0] if len(control_points) > 1 else np.swapaxes(control_points[0], 0, 1)


def settled(net: Net, bound_u: float, bound_v: float) -> Net:
    """The surface with all parameters moved to the feet of the points on it, as long as errors fall and bounds hold."""
    limit_u, limit_v = max(bound_u, net.along.excess.max()), max(bound_v, net.across.excess.max())
    best, squares = net, np.inf
    for _ in range(SETTLING):
        residuals = net.along.rows.data - net.at_points(0, 0)
        now = float(np.sum(residuals**2))
        if now >= squares or net.along.excess.max() > limit_u or net.across.excess.max() > limit_v:
            break
        best, squares = net, now
        try:
            net = _moved(net, residuals)
        except BsmapError:
            break
    return best


def _moved(net: Net, residuals: Array) -> Net:
    """The surface fitted anew on its knots, after one step of the parameters that points of a beam or a scan share."""
    rows, row = net.along.rows, net.across.rows
    shape = rows.allowance.shape
    line = np.broadcast_to(rows.row[:, None] if rows.n_rows > 1 else np.arange(shape[1]), shape)
    row = moved(row, common_steps(line, net.at_points(0, 1), residuals))
    if rows.place is not None:
        beam = np.broadcast_to(rows.place[:, None], shape)
        rows = moved(rows, common_steps(beam, net.at_points(1, 0), residuals))
    along = Refined(rows, fit_curves(rows, net.along.fit.knots, net.degree_u))
    row = row._replace(data=columns_of(along.fit))
    across = Refined(row, fit_curves(row, net.across.fit.knots, net.degree_v))
    return net._replace(along=along, across=across)
