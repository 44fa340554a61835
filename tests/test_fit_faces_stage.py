"""The fit of faces as a whole: PointCloud -> trimmed surfaces, on a corridor and a room of known truth."""

from functools import cache

import numpy as np
import pytest
from face_scenes import corridor_set, simulated_place
from scipy.spatial import cKDTree

from bsmap_cli.core.beams import beam_origins
from bsmap_cli.core.trims import inside_trims
from bsmap_cli.core.uncertainty import sensor_covariance
from bsmap_cli.errors import BsmapError
from bsmap_cli.evaluate import distance_to_mesh, surface_samples
from bsmap_cli.export.tessellation import tessellate
from bsmap_cli.fit import fit_surfaces
from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
from bsmap_cli.model import HeightCovariance
from bsmap_cli.params import FitParams

FACES = FitParams(method="faces")


@cache
def corridor():
    place = corridor_set()
    return place, fit_surfaces(place.cloud, FACES)


@cache
def room():
    place = simulated_place("room")
    return place, fit_surfaces(place.cloud, FACES)


def control_points(surface_map):
    return sum(surface.control_points.size // 3 for surface in surface_map.surfaces)


@pytest.mark.parametrize("made", [corridor, room])
def test_faces_lie_on_the_truth_and_nothing_hangs_in_the_air(made):
    place, surface_map = made()
    distance = distance_to_mesh(surface_samples(surface_map, 0.05), place.vertices, place.triangles)
    assert distance.mean() < 0.0012
    assert np.quantile(distance, 0.99) < 0.01


@pytest.mark.parametrize("made", [corridor, room])
def test_surfaces_tell_from_which_side_the_beams_came(made):
    place, surface_map = made()
    cloud = place.cloud
    tree = cKDTree(cloud.points)
    for surface in surface_map.surfaces:
        mesh = tessellate(surface, 0.002)
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
        middle, normal = (a + b + c) / 3.0, surface.side * np.cross(b - a, c - a)
        nearest = tree.query(middle)[1]
        beam = beam_origins(cloud, nearest) - cloud.points[nearest]
        assert np.sum(normal * beam) > 0.0, surface.name


def test_corridor_needs_few_control_points_and_leaves_few_beams():
    place, surface_map = corridor()
    assert control_points(surface_map) <= 60
    figures = surface_map.notes["fit"]["set-01"]
    assert figures["in_faces"] > 0.99 * figures["beams"] == 0.99 * len(place.cloud.points)
    assert figures["range_sigma"] == pytest.approx(0.01, rel=0.05)


def test_room_leaves_few_beams_those_of_walls_that_two_scans_tell_of_among_the_faces():
    _, surface_map = room()
    kinds = {data_set.name: data_set.movement for data_set in surface_map.data_sets}
    for name, figures in surface_map.notes["fit"].items():
        assert figures["in_faces"] > {"translation": 0.998, "rotation": 0.985}[kinds[name]] * figures["beams"]


def test_both_faces_of_a_crease_run_along_it():
    """The sides of the loops that refer to a crease lie on its points, to the rounding of the surfaces' meeting."""
    from bsmap_cli.core.bspline import evaluate_surface

    _, surface_map = corridor()
    assert len(surface_map.creases) >= 6
    by_name = {surface.name: surface for surface in surface_map.surfaces}
    for number, crease in enumerate(surface_map.creases):
        for name in crease.surfaces:
            surface = by_name[name]
            corners = [loop.parameters[loop.creases == number] for loop in surface.trims]
            at = evaluate_surface(surface, *np.concatenate(corners).T)
            assert len(at) >= len(crease.points) - 1
            gap = np.linalg.norm(at[:, None] - crease.points, axis=2).min(axis=1)
            assert gap.max() < 0.003


def test_recess_leaves_a_hole_in_the_ceiling():
    _, surface_map = corridor()
    heights = {s.name: s.control_points[..., 2].mean() for s in surface_map.surfaces}
    ceiling = next(
        s for s in surface_map.surfaces if abs(heights[s.name] - 2.6) < 0.02 and np.ptp(s.control_points[..., 2]) < 0.1
    )
    grid = np.stack(np.meshgrid(np.linspace(0, 1, 80), np.linspace(0, 1, 80), indexing="ij"), -1).reshape(-1, 2)
    from bsmap_cli.core.bspline import evaluate_surface

    at = evaluate_surface(ceiling, *grid.T)
    inside = inside_trims(ceiling, grid)
    hole = (np.abs(at[:, 0] - 1.0) < 0.3) & (np.abs(at[:, 1] - 1.15) < 0.4)
    assert not inside[hole].any()
    before = (np.abs(at[:, 0] - 0.2) < 0.2) & (np.abs(at[:, 1] - 1.0) < 0.6)
    assert inside[before].all()


def test_mesh_of_a_trimmed_face_has_the_area_of_its_loops():
    _, surface_map = corridor()
    for surface in surface_map.surfaces:
        mesh = tessellate(surface, 0.002)
        a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        grid = np.stack(np.meshgrid(*(np.linspace(0.0025, 0.9975, 200),) * 2, indexing="ij"), -1).reshape(-1, 2)
        whole = tessellate(surface.__class__(**{**vars(surface), "trims": ()}), 0.002)
        a, b, c = np.moveaxis(whole.vertices[whole.triangles], 1, 0)
        full = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
        assert area == pytest.approx(full * inside_trims(surface, grid).mean(), rel=0.03)


def test_sensor_covariance_is_that_of_the_heights():
    """Against the plain sum over pairs of control points."""
    _, surface_map = corridor()
    from reference import naive_basis

    surface = surface_map.surfaces[0]
    covariance = surface.covariance
    assert isinstance(covariance, HeightCovariance)
    directions = np.broadcast_to(covariance.directions, surface.control_points.shape).reshape(-1, 3)
    u, v = 0.3, 0.8
    nu, nv = surface.control_points.shape[:2]
    basis = np.array(
        [
            naive_basis(surface.knots_u, surface.degree_u, i, u) * naive_basis(surface.knots_v, surface.degree_v, j, v)
            for i in range(nu)
            for j in range(nv)
        ]
    )
    G = basis * directions.T
    np.testing.assert_allclose(sensor_covariance(surface, [u], [v])[0], G @ covariance.matrix @ G.T, rtol=1e-9)
    assert 1e-5 < np.sqrt(np.trace(G @ covariance.matrix @ G.T)) < 2e-3


def test_file_gives_the_same_faces_back(tmp_path):
    _, surface_map = corridor()
    for name in ("a.json", "b.json"):
        write_surfaces(tmp_path / name, surface_map)
        surface_map = read_surfaces(tmp_path / name)
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    assert surface_map.creases
    assert all(surface.trims for surface in surface_map.surfaces)


def test_same_cloud_gives_the_same_faces():
    place, first = corridor()
    second = fit_surfaces(place.cloud, FACES)
    for a, b in zip(first.surfaces, second.surfaces, strict=True):
        np.testing.assert_array_equal(a.control_points, b.control_points)


def test_cloud_without_movement_is_refused():
    from dataclasses import replace

    place, _ = corridor()
    still = replace(place.cloud, scan_poses=np.zeros_like(place.cloud.scan_poses))
    with pytest.raises(BsmapError, match="the robot stands still"):
        fit_surfaces(still, FACES)
