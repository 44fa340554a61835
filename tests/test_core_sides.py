"""Which side of a surface is meant: by the sign of S_u x S_v."""

import numpy as np
import pytest
from face_maps import wall

from bsmap_cli.core.sides import side_towards


@pytest.mark.parametrize("sign", [1, -1])
def test_side_is_the_one_to_which_most_vectors_point(sign):
    flat = wall("a/01", 0.0, 4.0)
    P = flat.control_points
    normal = np.cross(P[1, 0] - P[0, 0], P[0, 1] - P[0, 0])
    uv = np.array([[0.1, 0.2], [0.5, 0.5], [1.5, -0.5]])
    assert side_towards(flat, uv, sign * np.array([normal, normal, -normal])) == sign


def test_nothing_tells_no_side():
    assert side_towards(wall("a/01", 0.0, 4.0), np.zeros((0, 2)), np.zeros((0, 3))) == 0
