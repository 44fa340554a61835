"""Covariance of planes among bilinear patches."""

import numpy as np
import pytest

from bsmap_cli.core.uncertainty import FROM_THREE, is_plane, with_twist


def fits(s, t, power):
    """Covariances (4, 4) of the corners' heights, of a bilinear fit to points of unit noise and of that of a plane.

    s, t : of a grid of points, which count by (2 + s) ** power.
    """
    s, t = (x.ravel() for x in np.meshgrid(s, t, indexing="ij"))
    weights = (2.0 + s) ** power
    heights = np.stack([(1 - s) * (1 - t), (1 - s) * (1 + t), (1 + s) * (1 - t), (1 + s) * (1 + t)], axis=1) / 4.0
    whole = np.linalg.inv(heights.T @ (weights[:, None] * heights))
    plane = heights @ FROM_THREE
    return whole, FROM_THREE @ np.linalg.inv(plane.T @ (weights[:, None] * plane)) @ FROM_THREE.T


@pytest.mark.parametrize(
    ("s", "t", "power"),
    [
        ((-1.0, 1.0), (-1.0, 1.0), 0),
        (np.linspace(-1, 1, 7), np.linspace(-0.5, 0.2, 9) ** 3, 0),
        ((-1, 0, 0.5), (0, 1), 3),
    ],
)
def test_covariance_with_its_twist_is_that_of_the_bilinear_fit(s, t, power):
    whole, plane = fits(s, t, power)
    assert is_plane(plane * 1e-6)
    assert not is_plane(whole * 1e-6)
    np.testing.assert_allclose(with_twist(plane), whole, rtol=1e-7, atol=1e-10 * np.abs(whole).max())


def test_what_a_plane_tells_is_not_changed_by_its_twist():
    """Information on the three heights: that of their covariance alone."""
    _, plane = fits(np.linspace(-1, 0.3, 5), np.linspace(-0.2, 1, 4), 2)
    told = FROM_THREE.T @ np.linalg.solve(with_twist(plane), FROM_THREE)
    np.testing.assert_allclose(told, np.linalg.inv(plane[:3, :3]), rtol=1e-9)
