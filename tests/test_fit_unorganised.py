"""Faces of points without scan order: a box room of known truth."""

from functools import cache

import numpy as np
import pytest
from scattered import DOOR, SIZE, WINDOW, box_room

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.polygons import winding_number
from bsmap_cli.core.uncertainty import sensor_covariance
from bsmap_cli.errors import BsmapError, ParameterError
from bsmap_cli.fit import fit_unorganised
from bsmap_cli.fit.coverage import cover
from bsmap_cli.fit.growing import measure_scale
from bsmap_cli.model import ScatteredCloud, SurfaceMap
from bsmap_cli.params import FitParams

SIGMA = 0.005


@cache
def fitted(seed: int = 0, count: int = 60_000) -> SurfaceMap:
    return fit_unorganised(ScatteredCloud(box_room(count, seed=seed)), FitParams())


def samples(surface, count=400):
    """Parameters (n, 2) and points (n, 3) inside a surface's trims; the axis across it and its true place there."""
    uv = np.random.default_rng(0).random((count, 2))
    uv = uv[winding_number(uv, [loop.parameters for loop in surface.trims]) > 0]
    axis = int(np.argmax(np.abs(surface.covariance.directions[0, 0])))
    points = evaluate_surface(surface, uv[:, 0], uv[:, 1])
    return uv, points, axis, SIZE[axis] * np.rint(points[:, axis].mean() / SIZE[axis])


def on_surface(surface, point):
    """Whether a point (3,) lies on the trimmed surface, by its nearest corner parameters: the surface is flat."""
    corner, along, up = surface.control_points[0, 0], surface.control_points[-1, 0], surface.control_points[0, -1]
    uv = [np.dot(point - corner, end - corner) / np.dot(end - corner, end - corner) for end in (along, up)]
    return winding_number(np.array([uv]), [loop.parameters for loop in surface.trims])[0] > 0


def wall(surface_map, axis):
    """The wall that lies at 0 across an axis."""
    found = []
    for surface in surface_map.surfaces:
        _, _, across, place = samples(surface)
        if across == axis and place == 0.0:
            found.append(surface)
    assert len(found) == 1
    return found[0]


def test_each_side_of_the_room_is_one_flat_face():
    found = fitted()
    assert len(found.surfaces) == 6
    assert {s.control_points.shape for s in found.surfaces} == {(2, 2, 3)}
    assert {(axis, place) for _, _, axis, place in map(samples, found.surfaces)} == {
        (axis, place) for axis in range(3) for place in (0.0, SIZE[axis])
    }


def test_faces_lie_within_a_fraction_of_the_noise():
    errors = [points[:, axis] - place for _, points, axis, place in map(samples, fitted().surfaces)]
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.05 * SIGMA


def test_noise_and_residuals_are_those_of_the_points():
    found = fitted()
    figures = found.notes["fit"]["set-01"]
    assert figures["sigma"] == pytest.approx(SIGMA, rel=0.05)
    assert all(s.residuals.rms == pytest.approx(SIGMA, rel=0.05) for s in found.surfaces)
    assert figures["in_faces"] == sum(s.residuals.points for s in found.surfaces)
    assert figures["in_faces"] + figures["rest"] == figures["points"] == len(box_room())
    assert figures["in_faces"] > 0.99 * figures["points"]
    assert "no scan order" in figures["remark"]


def test_covariance_tells_the_error():
    """Mean normalised error squared over six rooms of six faces; 1 where the covariance is right."""
    ratios = []
    for seed in range(6):
        for surface in fitted(seed, 15_000).surfaces:
            uv, points, axis, place = samples(surface)
            variance = sensor_covariance(surface, *uv.T)[:, axis, axis]
            ratios.append(np.mean((points[:, axis] - place) ** 2 / variance))
    assert 0.5 < np.mean(ratios) < 2.0


def test_there_is_no_pose_part():
    found = fitted()
    assert [(d.movement, d.first_scan, d.last_scan) for d in found.data_sets] == [("unorganised", 0, 0)]
    assert not any(part.covariance.any() for s in found.surfaces for part in s.covariance.pose)


@pytest.mark.parametrize(("axis", "hole"), [(0, WINDOW), (1, DOOR)])
def test_openings_stay_open(axis, hole):
    surface = wall(fitted(), axis)
    low, high = hole
    low, high = low + 0.06, high - np.array([0.06, 0.06])
    for share in np.stack(np.meshgrid(*[np.linspace(0.0, 1.0, 9)] * 2), axis=-1).reshape(-1, 2):
        inside = np.insert(low + share * (high - low), axis, 0.0)
        assert not on_surface(surface, inside)
    beside = np.insert(np.array([high[0] + 0.3, 1.0]), axis, 0.0)
    assert on_surface(surface, beside)


def test_faces_reach_nearly_to_the_edges():
    """To three times the distance of the points, which is 4 cm."""
    surface = wall(fitted(), 1)
    for corner in ([0.12, 0.0, 0.12], [4.88, 0.0, 0.12], [0.12, 0.0, 2.38], [4.88, 0.0, 2.38]):
        assert on_surface(surface, np.array(corner))


def test_order_of_points_and_repeated_ones_do_not_matter():
    points = box_room(20_000)
    turned = np.concatenate([points[::-1], points[:100]])
    one, other = (fit_unorganised(ScatteredCloud(p), FitParams()) for p in (points, turned))
    assert other.notes["fit"]["set-01"]["repeated"] == 100
    assert len(one.surfaces) == len(other.surfaces)
    for a, b in zip(one.surfaces, other.surfaces, strict=True):
        np.testing.assert_array_equal(a.control_points, b.control_points)
        np.testing.assert_array_equal(a.trims[0].parameters, b.trims[0].parameters)


def test_far_away_coordinates_give_the_same_room():
    shift = np.array([500_000.0, 5_000_000.0, 300.0])
    moved = fit_unorganised(ScatteredCloud(box_room(20_000) + shift), FitParams())
    assert len(moved.surfaces) == 6
    assert moved.notes["fit"]["set-01"]["sigma"] == pytest.approx(SIGMA, rel=0.1)


def test_pillar_becomes_one_round_face():
    rng = np.random.default_rng(1)
    angle, z = rng.uniform(-2.5, 2.5, 8000), rng.uniform(0.0, 2.5, 8000)
    r = 0.4 + rng.normal(0.0, 0.003, 8000)
    points = np.column_stack([1.0 + r * np.cos(angle), 2.0 + r * np.sin(angle), z])
    found = fit_unorganised(ScatteredCloud(points), FitParams())
    assert len(found.surfaces) == 1
    uv = rng.random((500, 2))
    at = evaluate_surface(found.surfaces[0], uv[:, 0], uv[:, 1])
    assert np.abs(np.hypot(at[:, 0] - 1.0, at[:, 1] - 2.0) - 0.4).max() < 0.003


def test_curved_wall_gets_the_control_points_that_it_needs():
    rng = np.random.default_rng(2)
    x, z = rng.uniform(0.0, 4.0, 20_000), rng.uniform(0.0, 2.0, 20_000)
    points = np.column_stack([x, 0.15 * np.sin(2.0 * x) + rng.normal(0.0, 0.003, len(x)), z])
    found = fit_unorganised(ScatteredCloud(points), FitParams())
    assert len(found.surfaces) == 1
    _, at, _, _ = samples(found.surfaces[0])
    assert np.abs(at[:, 1] - 0.15 * np.sin(2.0 * at[:, 0])).max() < 0.003
    assert 4 < found.surfaces[0].control_points.size / 3 < 40


def test_sphere_is_divided_into_few_height_fields():
    rng = np.random.default_rng(6)
    points = rng.normal(size=(15_000, 3))
    points *= (1.0 + rng.normal(0.0, 0.003, (15_000, 1))) / np.linalg.norm(points, axis=1, keepdims=True)
    found = fit_unorganised(ScatteredCloud(points), FitParams())
    assert 6 <= len(found.surfaces) <= 10
    assert sum(s.residuals.points for s in found.surfaces) > 0.98 * len(points)
    for surface in found.surfaces:
        _, at, _, _ = samples(surface)
        off = np.abs(np.linalg.norm(at, axis=1) - 1.0)
        assert np.sqrt(np.mean(off**2)) < 0.004
        assert off.max() < 0.02


def test_both_sides_of_a_wall_stay_two_faces():
    points = box_room(40_000)
    back = points[np.abs(points[:, 1]) < 0.03] - [0.0, 0.2, 0.0]
    found = fit_unorganised(ScatteredCloud(np.concatenate([points, back])), FitParams())
    assert len(found.surfaces) == 7


def test_outliers_and_a_point_far_away_change_nothing():
    rng = np.random.default_rng(7)
    points = box_room(30_000)
    stray = np.concatenate([rng.uniform(-2.0, 8.0, (1000, 3)), [[1e7, 0.0, 0.0]]])
    found = fit_unorganised(ScatteredCloud(np.concatenate([points, stray])), FitParams())
    assert len(found.surfaces) == 6
    assert found.notes["fit"]["set-01"]["sigma"] == pytest.approx(SIGMA, rel=0.05)
    assert found.notes["fit"]["set-01"]["rest"] > 900


def test_exact_points_get_a_small_noise_and_flat_faces():
    found = fit_unorganised(ScatteredCloud(box_room(20_000, sigma=0.0)), FitParams())
    assert len(found.surfaces) == 6
    assert 0.0 < found.notes["fit"]["set-01"]["sigma"] < 0.001
    assert max(s.residuals.maximum for s in found.surfaces) < 1e-4


def test_points_in_a_jumble_are_rest():
    """A ball full of points is no surface, however many of them a plane through it happens to meet."""
    rng = np.random.default_rng(8)
    jumble = rng.normal([2.0, 2.0, 1.2], 0.1, (8000, 3))
    found = fit_unorganised(ScatteredCloud(np.concatenate([box_room(40_000), jumble])), FitParams())
    assert len(found.surfaces) == 6
    assert found.notes["fit"]["set-01"]["rest"] > 7900


def test_scale_follows_spacing_and_noise():
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.random((10_000, 2)), rng.normal(0.0, 0.004, 10_000)])
    scale = measure_scale(flat)
    assert scale.spacing == pytest.approx(0.01, rel=0.15)
    assert scale.sigma == pytest.approx(0.004, rel=0.15)


def test_cover_runs_around_holes_clockwise():
    rng = np.random.default_rng(4)
    flat = rng.random((8000, 2))
    flat = flat[np.linalg.norm(flat - 0.5, axis=1) > 0.2]
    loops = cover(flat, 0.001)
    assert len(loops) == 2
    inside = winding_number(np.array([[0.5, 0.5], [0.1, 0.1], [0.5, 0.9], [1.1, 0.5]]), loops)
    np.testing.assert_array_equal(inside, [0, 1, 1, 0])


def test_what_it_refuses():
    rng = np.random.default_rng(5)
    with pytest.raises(ParameterError, match="needs scan lines"):
        fit_unorganised(ScatteredCloud(box_room(1000)), FitParams(method="paper"))
    with pytest.raises(BsmapError, match="1 distinct points"):
        fit_unorganised(ScatteredCloud(np.ones((100, 3))), FitParams())
    with pytest.raises(BsmapError, match="no smooth face in 500 points"):
        fit_unorganised(ScatteredCloud(rng.random((500, 3))), FitParams())
    line = np.linspace(0.0, 1.0, 500)[:, None] * [1.0, 2.0, 3.0]
    with pytest.raises(BsmapError, match="no smooth face"):
        fit_unorganised(ScatteredCloud(line), FitParams())
    with pytest.raises(ValueError, match=r"shape \(5, 2\)"):
        ScatteredCloud(np.zeros((5, 2)))
