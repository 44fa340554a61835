"""Straight lines through points, all alike or weighted."""

import numpy as np
import pytest

from bsmap_cli.core.lines import straight_line


@pytest.mark.parametrize("d", [2, 3])
def test_line_runs_through_what_lies_on_it(d):
    start, way = np.arange(1.0, d + 1.0), np.full(d, d**-0.5)
    middle, found = straight_line(start + np.linspace(-2.0, 3.0, 7)[:, None] * way)
    np.testing.assert_allclose(middle, start + 0.5 * way)
    assert abs(found @ way) == pytest.approx(1.0)


def test_what_weighs_next_to_nothing_does_not_move_it():
    places = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [1.0, 5.0]])
    middle, found = straight_line(places, np.array([1.0, 1.0, 1.0, 1e-12]))
    np.testing.assert_allclose(middle, [1.0, 0.0], atol=1e-9)
    assert abs(found[0]) == pytest.approx(1.0)
    assert abs(straight_line(places)[1][1]) == pytest.approx(1.0)
