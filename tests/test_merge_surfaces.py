"""Merging whole maps: known answers, refusals, order, names, an end."""

import re
from dataclasses import replace

import numpy as np
import pytest
from merge_scenes import map_of, plane, wall

from bsmap_cli.core.gaussian import unpack
from bsmap_cli.core.uncertainty import sensor_covariance, surface_covariance
from bsmap_cli.errors import BsmapError
from bsmap_cli.merge import merge_surfaces
from bsmap_cli.merge.fusion import Fused, fuse, pair_samples
from bsmap_cli.merge.patch import make_patch
from bsmap_cli.merge.refit import refit
from bsmap_cli.model import BSplineSurface, SurfaceCovariance, SurfaceMap
from bsmap_cli.params import MergeParams

PARAMS = MergeParams()


def merged(*surfaces: BSplineSurface, **options: float) -> SurfaceMap:
    return merge_surfaces([map_of(*surfaces)], MergeParams(**options))


def outcomes(result: SurfaceMap) -> list[tuple[str, str, str]]:
    return [(d.first, d.second, d.outcome) for d in result.decisions]


def by_data_sets(result: SurfaceMap) -> dict[tuple[str, ...], BSplineSurface]:
    return {surface.data_sets: surface for surface in result.surfaces}


def test_two_walls_become_one_and_two_rests() -> None:
    result = merged(wall("a", 0, 4), wall("b", 2, 6, y=2.01))
    pieces = by_data_sets(result)
    assert set(pieces) == {("a", "b"), ("a",), ("b",)}
    ranges = {k: (s.control_points[..., 0].min(), s.control_points[..., 0].max()) for k, s in pieces.items()}
    assert ranges[("a", "b")] == pytest.approx((2.0, 4.0), abs=1e-6)
    assert ranges[("a",)] == pytest.approx((0.0, 2.0), abs=1e-6)
    assert ranges[("b",)] == pytest.approx((4.0, 6.0), abs=1e-6)
    assert outcomes(result)[0] == ("a", "b", "merged")
    assert result.notes["mergings"] == 1


@pytest.mark.parametrize(("sigma_b", "share"), [(0.003, 0.5), (0.006, 0.2), (0.0015, 0.8)])
def test_merged_wall_lies_between_by_the_weights(sigma_b: float, share: float) -> None:
    a = wall("a", 0, 4, sigma=0.003, pose_sigma=0.0)
    b = wall("b", 0, 4, y=2.01, sigma=sigma_b, pose_sigma=0.0)
    a, b = (replace(s, covariance=replace(s.covariance, pose=_no_pose_error(s))) for s in (a, b))
    result = merged(a, b)
    assert len(result.surfaces) == 1
    y = result.surfaces[0].control_points[..., 1]
    kept_first = result.surfaces[0].data_sets[0] == "a"
    np.testing.assert_allclose(y, 2.0 + 0.01 * share, rtol=0, atol=1e-9)
    at = np.linspace(0.1, 0.9, 5)
    before = sensor_covariance(a if kept_first else b, at, at)[:, 1, 1]
    after = sensor_covariance(result.surfaces[0], at, at)[:, 1, 1]
    # The plane needs fewer control points than it had: the average over the samples spreads the noise differently.
    gain = share if kept_first else 1.0 - share
    np.testing.assert_allclose(after, (1.0 - gain) * before, rtol=0.15)


def _no_pose_error(surface: BSplineSurface):
    return tuple(replace(part, covariance=np.zeros((3, 3))) for part in surface.covariance.pose)


def test_fused_samples_are_the_product_of_both_densities_along_the_normal() -> None:
    first, second = make_patch(wall("a", 0, 4, sigma=0.003)), make_patch(wall("b", 0, 4, y=2.01, sigma=0.002))
    pairing = pair_samples(first, second, PARAMS.distance)
    fused = fuse(first, second, pairing, PARAMS)
    assert pairing.hit.all()
    a, b = pairing.first + pairing.first_pose, pairing.second + pairing.second_pose
    y, gain = fused.points.reshape(-1, 3)[:, 1], a / (a + b)
    np.testing.assert_allclose(y, 2.0 + 0.01 * gain, rtol=0, atol=1e-12)
    before, after = (unpack(c.blocks).reshape(-1, 3, 3) for c in (pairing.covariance, fused.covariance))
    sensor = (1 - gain) ** 2 * pairing.first + gain**2 * pairing.second
    np.testing.assert_allclose(after[:, 1, 1], sensor, rtol=1e-9)
    np.testing.assert_allclose(after[:, 0, 0], before[:, 0, 0], rtol=1e-9)  # feet say nothing along the wall


def test_refit_on_the_patch_s_own_knots_changes_nothing_unmoved() -> None:
    surface = wall("a", 0, 4)
    points = surface.control_points + 0.05 * np.random.default_rng(0).normal(size=surface.control_points.shape)
    patch = make_patch(replace(surface, control_points=points))
    pairing = pair_samples(patch, make_patch(wall("b", 0, 4, y=4.0)), PARAMS.distance)
    assert not pairing.hit.any()
    fused = Fused(pairing.points, pairing.covariance, 0.0, 0)
    fitted = refit(patch.surface, pairing, fused, MergeParams(bound_u=1e-4, bound_v=1e-4))
    np.testing.assert_allclose(fitted.spline.control_points, points, rtol=0, atol=1e-10)
    np.testing.assert_allclose(fitted.covariance.blocks, surface.covariance.blocks, rtol=0, atol=1e-12)


def test_covariance_shrinks_with_every_merging() -> None:
    walls = [wall(name, 0, 4) for name in "abc"]
    at = np.linspace(0.1, 0.9, 5)
    variances = [surface_covariance(merged(*walls[:n]).surfaces[0], at, at)[:, 1, 1].mean() for n in (1, 2, 3)]
    assert variances[1] == pytest.approx(variances[0] / 2, rel=0.05)
    assert variances[2] == pytest.approx(variances[0] / 3, rel=0.05)


def test_pose_shares_add_up_to_one() -> None:
    for surface in merged(wall("a", 0, 4), wall("b", 2, 6), wall("c", 1, 3)).surfaces:
        assert sum(part.weight for part in surface.covariance.pose) == pytest.approx(1.0)
        assert {part.data_set for part in surface.covariance.pose} == set(surface.data_sets)


def test_faces_of_a_thin_wall_stay_apart() -> None:
    a, b = wall("a", 0, 4), wall("b", 0, 4, y=2.05, centre=(2.0, 4.0))
    result = merged(a, b)
    assert result.surfaces == (a, b)
    assert outcomes(result) == [("a", "b", "refused")]
    assert result.decisions[0].reason == "they face opposite ways"


def test_floor_and_ceiling_of_a_thin_slab_stay_apart() -> None:
    floor = plane("a", (0, 0, 0.53), (4, 0, 0), (0, 3, 0), centre=(2, 1.5))
    under = plane("b", (0, 0, 0.48), (4, 0, 0), (0, 3, 0), centre=(2, 1.5))
    assert merged(floor, under).decisions[0].reason == "they face opposite ways"


def test_inconsistent_walls_are_refused_with_figures() -> None:
    a, b = wall("a", 0, 4), wall("b", 0, 4, y=2.06)
    result = merged(a, b)
    assert result.surfaces == (a, b)
    decision = result.decisions[0]
    assert decision.outcome == "refused"
    assert "differ by more than their covariances allow" in decision.reason
    assert decision.figures["mean_distance"] == pytest.approx(0.06)
    assert decision.figures["pose_distance"] > decision.figures["pose_gate"]


def test_a_step_within_one_pose_error_is_refused() -> None:
    """A common pose error cannot explain that one half agrees and the other does not."""
    a = wall("a", 0, 4, pose_sigma=0.02)
    moved = wall("b", 0, 4, pose_sigma=0.02)
    points = moved.control_points.copy()
    points[..., 1] += np.where(points[..., 0] > 2.0, 0.09, 0.0)
    result = merged(a, replace(moved, control_points=points))
    assert [d.outcome for d in result.decisions] == ["refused"]


def test_a_larger_pose_error_explains_the_offset() -> None:
    result = merged(wall("a", 0, 4), wall("b", 0, 4, y=2.06, pose_sigma=0.05))
    assert [d.outcome for d in result.decisions] == ["merged"]
    assert result.surfaces[0].control_points[..., 1].mean() == pytest.approx(2.0 + 0.06 * 0.04, abs=1e-3)


def test_surfaces_apart_are_not_touched() -> None:
    a, b, c = wall("a", 0, 4), wall("b", 5, 6), wall("c", 0, 4, y=3.0, centre=(2.0, 1.0))
    result = merged(a, b, c)
    assert result.surfaces == (a, b, c)
    assert result.decisions == ()


def test_overlap_of_crossing_strips_is_not_forced() -> None:
    """Two narrow strips that cross at 45 degrees: what is kept or merged covers both, and nothing else."""
    a = plane("a", (0, 0, 0), (6, 0, 0), (0, 1, 0), centre=(3, 0.5))
    s = np.sqrt(0.5)
    b = plane("b", (2, -1.5, 0), (6 * s * 0.8, 6 * s * 0.8, 0), (-s, s, 0), centre=(3, 0.5))
    result = merged(a, b)
    assert result.decisions
    areas = sum(make_area(surface) for surface in result.surfaces)
    assert 6.0 + 4.8 - 1.5 < areas <= 6.0 + 4.8 + 1e-6


def make_area(surface: BSplineSurface) -> float:
    P = surface.control_points
    return float(np.linalg.norm(np.cross(P[-1, 0] - P[0, 0], P[0, -1] - P[0, 0])))


def test_three_overlapping_walls_end_as_one_layer() -> None:
    result = merged(wall("a", 0, 4), wall("b", 2, 6, y=2.004), wall("c", 1, 5, y=1.997))
    assert sum(make_area(surface) for surface in result.surfaces) == pytest.approx(12.0, rel=1e-3)
    assert result.notes["pairs_left_at_limit"] == 0


def test_same_input_gives_same_map() -> None:
    surfaces = [wall("a", 0, 3), wall("b", 2, 4, y=2.004), wall("c", 0, 2, y=1.997)]
    one, two = merged(*surfaces), merged(*surfaces)
    assert one.decisions == two.decisions
    for a, b in zip(one.surfaces, two.surfaces, strict=True):
        assert (a.name, a.data_sets) == (b.name, b.data_sets)
        np.testing.assert_array_equal(a.control_points, b.control_points)


def test_order_of_two_surfaces_does_not_matter() -> None:
    a, b = wall("a", 0, 4), wall("b", 2, 6, y=2.01)
    one, two = by_data_sets(merged(a, b)), by_data_sets(merged(b, a))
    assert {frozenset(k) for k in one} == {frozenset(k) for k in two}
    y = [next(s for k, s in m.items() if len(k) == 2).control_points[..., 1] for m in (one, two)]
    np.testing.assert_allclose(y[0].mean(), y[1].mean(), atol=1e-6)


def test_names_of_several_maps_stay_unique() -> None:
    first, second = map_of(wall("a", 0, 4)), map_of(wall("a", 2, 6))
    result = merge_surfaces([first, second], PARAMS)
    assert {data_set.name for data_set in result.data_sets} == {"a", "2.a"}
    names = [surface.name for surface in result.surfaces]
    assert len(set(names)) == len(names)
    assert {name for s in result.surfaces for name in s.data_sets} == {"a", "2.a"}
    assert merge_surfaces([first, map_of(wall("b", 7, 9))], PARAMS).surfaces[1].name == "b"


def test_maps_without_surfaces_are_merged() -> None:
    assert merge_surfaces([SurfaceMap((), ())], PARAMS).surfaces == ()


def test_surfaces_without_any_error_are_refused_by_name() -> None:
    def perfect(surface: BSplineSurface) -> BSplineSurface:
        c = surface.covariance
        covariance = SurfaceCovariance(0 * c.blocks, c.correlation_u, c.correlation_v, _no_pose_error(surface))
        return replace(surface, covariance=covariance)

    with pytest.raises(BsmapError, match=re.escape("both have zero covariance")):
        merged(perfect(wall("a", 0, 4)), perfect(wall("b", 0, 4)))
