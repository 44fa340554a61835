"""Which of the two sides of a surface is meant."""

import numpy as np

from bsmap_cli.core.bspline import Surface, evaluate_surface
from bsmap_cli.model import Array


def side_towards(surface: Surface, uv: Array, towards: Array) -> int:
    """+1 where S_u x S_v points with vectors `towards` (n, 3) at parameters uv (n, 2), taken together, -1 against them.

    Parameters outside [0, 1] count as at the nearest inside. 0 where there is nothing to tell it by.
    """
    u, v = np.clip(uv, 0.0, 1.0).T
    _, S_u, S_v = evaluate_surface(surface, u, v, 1)
    return int(np.sign(np.sum(np.cross(S_u, S_v) * towards)))
