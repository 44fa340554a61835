"""The paper's method as a whole: PointCloud -> SurfaceMap on the simulated room and on poor clouds."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scenes import simulated, true_slam_map

from bsmap_cli.cloud import make_cloud, pose_covariances
from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.core.gaussian import unpack
from bsmap_cli.core.uncertainty import surface_covariance
from bsmap_cli.errors import BsmapError
from bsmap_cli.evaluate import distance_to_mesh, transform_points
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.fit.lines import gather_lines, pose_part
from bsmap_cli.fit.movement import Movement
from bsmap_cli.params import CloudParams, FitParams

POSE_COVARIANCE = np.diag([1e-4, 2e-4, 1e-5])


@cache
def room_cloud():
    return make_cloud(true_slam_map(simulated("room"), POSE_COVARIANCE), CloudParams())


@cache
def room_surfaces():
    return fit_surfaces(room_cloud(), FitParams(method="paper"))


def pick(cloud, keep):
    """The cloud of the points that `keep` (n,) tells."""
    names = ("points", "scan_index", "beam_index", "time_ns", "covariances")
    return replace(cloud, **{name: getattr(cloud, name)[keep] for name in names})


def test_room_gives_its_seven_data_sets():
    surface_map = room_surfaces()
    kinds = [data_set.movement for data_set in surface_map.data_sets]
    assert kinds == ["translation", "rotation"] * 3 + ["translation"]
    assert [surface.name for surface in surface_map.surfaces] == [f"set-{k:02d}" for k in range(1, 8)]
    assert all(surface.data_sets == (surface.name,) for surface in surface_map.surfaces)
    assert set(surface_map.notes["fit"]) == {surface.name for surface in surface_map.surfaces}
    assert surface_map.decisions == ()


def test_surfaces_lie_on_the_room():
    simulation, surface_map = simulated("room"), room_surfaces()
    start = simulation.truth.poses[np.searchsorted(simulation.truth.time_ns, simulation.log.horizontal.time_ns[0])]
    u, v = np.random.default_rng(0).random((2, 2000))
    for surface in surface_map.surfaces:
        assert surface.residuals.mean < 0.025
        assert surface.residuals.points > 9000
        points = transform_points(start, evaluate_surface(surface, u, v))
        assert distance_to_mesh(points, simulation.vertices, simulation.triangles).mean() < 0.015
        assert surface.control_points.size / 3 < surface.residuals.points / 5


def test_sensor_part_is_the_cloud_covariance_without_the_pose_part():
    cloud = room_cloud()
    lines = gather_lines(cloud, Movement("translation", np.arange(20)), 4)
    taken = np.flatnonzero(cloud.scan_index < 20)
    pose = pose_covariances(
        cloud.points[taken, :2] - cloud.scan_poses[cloud.scan_index[taken], :2],
        cloud.scan_pose_covariances[cloud.scan_index[taken]],
    )
    np.testing.assert_allclose(unpack(lines.covariances), unpack(cloud.covariances[taken]) - pose, atol=1e-12)


def test_pose_part_gives_points_the_covariance_of_their_pose():
    """One pose only: turned about any centre, the covariance of a point stays what the pose gives it."""
    cloud = room_cloud()
    root = np.random.default_rng(0).normal(size=(3, 3)) * 0.01
    cloud = replace(cloud, scan_pose_covariances=np.tile(root @ root.T, (len(cloud.scan_poses), 1, 1)))
    movement = Movement("translation", np.array([3, 3]))
    part = pose_part(cloud, movement, "set")
    moved = pose_part(cloud, Movement("translation", np.array([3, 12])), "set")
    np.testing.assert_allclose(part.covariance, root @ root.T, atol=1e-15)
    assert np.linalg.eigvalsh(moved.covariance).min() > 0


def test_pose_part_keeps_what_poses_have_in_common_and_averages_the_rest():
    cloud = room_cloud()
    rng = np.random.default_rng(1)
    n = len(cloud.scan_poses)
    poses = np.column_stack([0.1 * np.arange(n), np.zeros(n), np.zeros(n)])
    shift = np.tile([[0.03, 0.0], [0.0, 0.02], [0.0, 0.0]], (n, 1, 1))
    own = np.diag([4e-4, 4e-4, 0.0])
    cloud = replace(cloud, scan_poses=poses, scan_pose_covariances=shift @ shift.swapaxes(1, 2) + own)
    cloud = replace(cloud, scan_pose_modes=shift)
    part = pose_part(cloud, Movement("translation", np.arange(19)), "set")
    np.testing.assert_allclose(part.modes, shift[0])
    # 1.8 m of way are 6 times the reach of a pose's own error.
    np.testing.assert_allclose(part.covariance, np.diag([9e-4, 4e-4, 0.0]) + own / 6, atol=1e-12)
    other = pose_part(cloud, Movement("translation", np.array([20, 21])), "other")
    assert other.trajectory == part.trajectory
    changed = replace(cloud, scan_pose_modes=shift + 1e-3 * rng.normal(size=shift.shape))
    assert pose_part(changed, Movement("translation", np.arange(19)), "set").trajectory != part.trajectory


def test_surface_covariance_is_small_and_positive():
    surface = room_surfaces().surfaces[0]
    u, v = np.random.default_rng(1).random((2, 200))
    covariance = surface_covariance(surface, u, v)
    assert np.linalg.eigvalsh(covariance).min() > -1e-15
    # The pose part does not average out: no point is surer than the poses are.
    assert covariance[:, 0, 0].min() >= POSE_COVARIANCE[0, 0]
    assert np.sqrt(np.trace(covariance, axis1=1, axis2=2).max()) < 0.1


def test_same_cloud_gives_the_same_surfaces():
    again = fit_surfaces(pick(room_cloud(), room_cloud().scan_index < 20), FitParams(method="paper"))
    first, second = room_surfaces().surfaces[0], again.surfaces[0]
    np.testing.assert_array_equal(first.control_points, second.control_points)
    np.testing.assert_array_equal(first.covariance.blocks, second.covariance.blocks)


def test_missing_returns_do_not_stop_the_fit():
    """Random returns are missing, some scans have none at all, and some a few."""
    cloud = room_cloud()
    rng = np.random.default_rng(2)
    keep = rng.random(len(cloud.points)) < 0.6
    keep &= ~np.isin(cloud.scan_index, [4, 5, 40, 80])
    keep &= ~(np.isin(cloud.scan_index, [8, 90]) & (cloud.beam_index > 5))
    surface_map = fit_surfaces(pick(cloud, keep), FitParams(method="paper"))
    assert len(surface_map.surfaces) == 7
    assert surface_map.notes["fit"]["set-01"]["scans"] == 17
    assert all(surface.residuals.mean < 0.05 for surface in surface_map.surfaces)


def test_data_set_without_points_is_left_out_and_said_so():
    cloud = room_cloud()
    surface_map = fit_surfaces(pick(cloud, cloud.scan_index >= 19), FitParams(method="paper", knots_per_pass=20))
    assert [surface.name for surface in surface_map.surfaces] == [f"set-{k:02d}" for k in range(2, 8)]
    assert len(surface_map.data_sets) == 7
    (decision,) = surface_map.decisions
    assert (decision.first, decision.outcome) == ("set-01", "refused")
    assert "needs 2 scan lines, here is 1" in decision.reason


def test_cloud_without_movement_is_refused():
    cloud = room_cloud()
    still = replace(cloud, scan_poses=np.zeros_like(cloud.scan_poses))
    with pytest.raises(BsmapError, match="the robot stands still in all of the cloud's 131 scans"):
        fit_surfaces(still, FitParams(method="paper"))


def test_cloud_with_too_few_points_is_refused():
    cloud = room_cloud()
    with pytest.raises(BsmapError, match="are too few"):
        fit_surfaces(pick(cloud, cloud.beam_index < 2), FitParams(method="paper"))


def test_bound_that_is_not_met_is_logged_and_noted(caplog):
    fit_surfaces(
        pick(room_cloud(), room_cloud().scan_index < 6), FitParams(method="paper", noise_margin=0.0, knots_per_pass=50)
    )
    assert "over the bound of 0.010 m: no room for more knots" in caplog.text


@pytest.mark.parametrize("degree", [1, 2, 5])
def test_other_degrees_fit_too(degree):
    cloud = pick(room_cloud(), room_cloud().scan_index < 19)
    surface_map = fit_surfaces(cloud, FitParams(method="paper", degree_u=degree, degree_v=degree))
    (surface,) = surface_map.surfaces
    assert (surface.degree_u, surface.degree_v) == (degree, degree)
    assert surface.residuals.mean < 0.04
