"""B-spline curves and surfaces on clamped knots over [0, 1]: basis functions, points, derivatives.

Free functions on arrays. A surface is anything with the attributes of `Surface`; `TensorSpline` is the smallest one.
The basis and the functions on knots are here, too, so that one import gives all of it.
"""

import numpy as np
from numpy.typing import ArrayLike

from bsmap_cli.core.basis import Surface, TensorSpline, basis_functions, design_matrix
from bsmap_cli.core.knots import Refined, clamped_knots, inner_knots, insert_knots, open_knots, restrict
from bsmap_cli.core.pieces import evaluate_pieces, polynomial_pieces
from bsmap_cli.model import Array

__all__ = [
    "Refined",
    "Surface",
    "TensorSpline",
    "basis_functions",
    "clamped_knots",
    "design_matrix",
    "evaluate_curve",
    "evaluate_grid",
    "evaluate_surface",
    "inner_knots",
    "insert_knots",
    "open_knots",
    "restrict",
]


def evaluate_curve(knots: Array, degree: int, control_points: Array, u: ArrayLike, derivatives: int = 0) -> Array:
    """Points of a curve and their derivatives, Eq. (23).

    Parameters
    ----------
    control_points : (n_control, d)
    u : (n,) parameters in [0, 1].

    Returns
    -------
    (n, d) points; with derivatives > 0 (derivatives + 1, n, d): points, first derivatives, and so on.
    """
    first, values = basis_functions(knots, degree, u, derivatives)
    local = control_points[first[:, None] + np.arange(degree + 1)]
    result = np.einsum("nkr,nrd->knd", values, local)
    return result if derivatives else result[0]


def evaluate_surface(surface: Surface, u: ArrayLike, v: ArrayLike, derivatives: int = 0) -> Array:
    """Points of a surface at scattered parameters, and their derivatives, Eq. (19).

    Where many batches are evaluated, `core.pieces` saves to prepare the surface each time.

    Parameters
    ----------
    u, v : (n,) parameters in [0, 1].
    derivatives : 0, 1 or 2, highest order wanted.

    Returns
    -------
    (n, d) points; with derivatives = 1 (3, n, d): S, S_u, S_v; with 2 (6, n, d): S, S_u, S_v, S_uu, S_uv, S_vv.
    """
    u, v = np.asarray(u, dtype=float), np.asarray(v, dtype=float)
    if u.ndim != 1 or u.shape != v.shape:
        raise ValueError(f"parameters u and v have shapes {u.shape} and {v.shape}, wanted (n,) both")
    points = evaluate_pieces(polynomial_pieces(surface), u, v, derivatives).transpose(0, 2, 1)
    return points if derivatives else points[0]


def evaluate_grid(surface: Surface, u: ArrayLike, v: ArrayLike) -> Array:
    """Points of a surface at all pairs of parameters u (n,) and v (m,): (n, m, d)."""
    along_u = design_matrix(surface.knots_u, surface.degree_u, u)
    along_v = design_matrix(surface.knots_v, surface.degree_v, v)
    planes = surface.control_points.transpose(2, 0, 1)
    return (along_u @ planes @ along_v.T).transpose(1, 2, 0)
