"""Numbers in whole units and as differences: what comes back, and that it is written alike again."""

import numpy as np
import pytest

from bsmap_cli.io.whole_numbers import (
    LEAST_ROOT,
    POSES,
    ROOTS,
    from_pose_root,
    from_whole,
    pose_root,
    runs_of,
    scaled_root,
    whole,
)
from bsmap_cli.model import Decision


@pytest.mark.parametrize("axes", [(), (0,), (0, 1)])
def test_values_come_back_within_half_a_unit_and_are_written_alike_again(axes):
    values = np.random.default_rng(0).normal(size=(5, 4, 3)) * 30.0
    numbers = whole(values, 1e5, axes)
    back = from_whole(np.array(numbers), 1e5, axes)
    assert np.abs(back - values).max() <= 0.5e-5 * (1.0 + 1e-9)
    assert whole(back, 1e5, axes) == numbers


def test_differences_are_those_to_the_one_before():
    assert whole([[1.0, 2.0], [1.5, 2.0], [1.0, 2.5]], 10.0, (0,)) == [[10, 20], [5, 0], [-5, 5]]
    assert whole(np.zeros((0, 3)), 10.0, (0,)) == []


def test_number_that_is_not_finite_is_refused():
    with pytest.raises(ValueError, match="not finite"):
        whole([np.nan], 1.0)


@pytest.mark.parametrize("size", [1e-5, 3e-5, 1e-4, 2e-3])
def test_root_keeps_variances_to_a_percent_and_is_found_again(size):
    """Over forty covariances of each size, some of heights that hardly differ."""
    rng = np.random.default_rng(1)
    for _ in range(40):
        half = rng.normal(size=(4, 4)) * size * rng.uniform(0.2, 1.0, 4)
        C = half @ half.T + (0.2 * size) ** 2 * np.eye(4)
        scale, root = scaled_root(C)
        assert np.diag(root).min() >= LEAST_ROOT
        back = root @ root.T * (scale / ROOTS) ** 2
        np.testing.assert_allclose(np.diag(back), np.diag(C), rtol=0.01)
        again = scaled_root(back)
        assert again[0] == scale
        np.testing.assert_array_equal(again[1], root)


def test_nearly_singular_covariance_has_no_root():
    assert scaled_root(np.ones((2, 2)) * 1e-8) is None


@pytest.mark.parametrize("rank", [0, 1, 2, 3])
def test_root_of_a_pose_keeps_what_is_worth_it_and_is_found_again(rank):
    """Over forty covariances: standard deviations to a hundredth of a millimetre and a millionth of a radian."""
    rng = np.random.default_rng(2)
    for _ in range(40):
        half = rng.normal(size=(3, rank)) * np.array([[1e-3], [5e-3], [2e-4]])
        numbers = pose_root(half @ half.T)
        back = from_pose_root(np.array(numbers, dtype=float))
        np.testing.assert_allclose(np.sqrt(np.diag(back)) * POSES, np.linalg.norm(half, axis=1) * POSES, atol=1.5)
        assert pose_root(back) == numbers


def test_decisions_that_follow_each_other_alike_are_put_together():
    joined = [Decision("a", f"b{k}", "merged", "same", {"area": float(k)}) for k in range(3)]
    other = Decision("a", "", "refused", "denied", {"denied": 0.5})
    runs = runs_of([*joined[:2], other, joined[2]])
    assert [run["reason"] for run in runs] == ["same", "denied", "same"]
    assert runs[0]["pairs"] == [["a", "b0", 0.0], ["a", "b1", 1.0]]
    assert runs[1] == {"outcome": "refused", "reason": "denied", "figures": ["denied"], "pairs": [["a", "", 0.5]]}
