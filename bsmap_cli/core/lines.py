"""Straight lines through points."""

import numpy as np

from bsmap_cli.model import Array


def straight_line(points: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """Point (d,) and unit direction (d,), of either sign, of the line nearest to points (n, d) in the squares' mean.

    weights : (n,) of the squares; all alike without.
    """
    middle = np.average(points, axis=0, weights=weights)
    away = points - middle if weights is None else (points - middle) * np.sqrt(weights)[:, None]
    return np.asarray(middle), np.asarray(np.linalg.svd(away, full_matrices=False)[2][0])
