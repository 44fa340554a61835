"""Which part of a trimmed surface is there."""

import numpy as np
from numpy.typing import NDArray

from bsmap_cli.core.polygons import winding_number
from bsmap_cli.model import Array, BSplineSurface


def inside_trims(surface: BSplineSurface, parameters: Array) -> NDArray[np.bool_]:
    """(n,) whether points at parameters (n, 2) belong to the surface: all of them where it has no trims."""
    if not surface.trims:
        return np.ones(len(parameters), dtype=bool)
    return winding_number(parameters, [loop.parameters for loop in surface.trims]) != 0
