"""Meshes of a whole map: surfaces that meet in a crease have the very same vertices there."""

import io

import numpy as np
import pytest
import trimesh
from face_maps import bow, bowed, floor, map_of, wall

from bsmap_cli.core.bspline import evaluate_surface
from bsmap_cli.evaluate import distance_to_mesh
from bsmap_cli.export import export_map
from bsmap_cli.export.tessellation import tessellate_map
from bsmap_cli.model import BSplineSurface, Crease, TrimLoop

HEIGHT = 0.1
"""Metres by which the wall is bowed."""


@pytest.fixture(scope="module")
def corner():
    """A bowed wall on a floor; their crease is a polyline of nine points on both."""
    x = np.linspace(0.0, 4.0, 9)
    line = np.column_stack([x, HEIGHT * bow(x), np.zeros(9)])
    upright, ground = bowed(wall("a/1", 0.0, 4.0), HEIGHT), floor("a/2", 0.0, 4.0)
    trims = [
        TrimLoop(np.concatenate([np.column_stack([x / 4.0, 0.0 * x]), [[1.0, 1.0], [0.0, 1.0]]]), marks(8, 3)),
        TrimLoop(np.concatenate([line[:, :2] / [4.0, 3.0], [[1.0, 1.0], [0.0, 1.0]]]), marks(8, 3)),
    ]
    faces = [
        BSplineSurface(**{**vars(surface), "trims": (loop,)})
        for surface, loop in zip((upright, ground), trims, strict=True)
    ]
    return map_of(*faces, creases=[Crease(("a/1", "a/2"), line)])


def marks(along, others):
    return np.concatenate([np.zeros(along), np.full(others, -1)]).astype(int)


def on_border(mesh):
    """Vertices at edges of one triangle only, as a set."""
    edges = np.sort(np.concatenate([mesh.triangles[:, k] for k in ([0, 1], [1, 2], [2, 0])]), axis=1)
    single, count = np.unique(edges, axis=0, return_counts=True)
    return {tuple(p) for p in mesh.vertices[np.unique(single[count == 1])].tolist()}


@pytest.mark.parametrize("tolerance", [0.02, 0.002, 0.0002])
def test_vertices_along_a_crease_are_the_same_in_both_meshes(corner, tolerance):
    upright, ground = tessellate_map(corner, tolerance)
    shared = on_border(upright) & on_border(ground)
    assert {tuple(p) for p in corner.creases[0].points.tolist()} <= shared
    low = {p for p in on_border(upright) if p[2] < 1e-3}
    assert low == shared == {p for p in on_border(ground) if p[1] < HEIGHT + 1e-3}
    assert len(shared) >= (9 if tolerance > 0.001 else 17)


def test_mesh_of_a_trimmed_curved_face_keeps_the_tolerance(corner):
    upright, _ = corner.surfaces
    mesh, _ = tessellate_map(corner, 0.0005)
    u, v = np.random.default_rng(0).uniform(0.01, 0.99, (2, 2000))
    assert distance_to_mesh(evaluate_surface(upright, u, v), mesh.vertices, mesh.triangles).max() < 0.0005


@pytest.mark.parametrize("ending", ["ply", "stl", "obj", "glb"])
def test_files_have_the_same_coordinates_on_both_sides(corner, ending):
    loaded = trimesh.load(io.BytesIO(export_map(corner, ending)), file_type=ending, process=False)
    meshes = list(loaded.geometry.values()) if isinstance(loaded, trimesh.Scene) else [loaded]
    vertices = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 3) for mesh in meshes])
    low = np.unique(vertices[np.abs(vertices[:, 2]) < 1e-3], axis=0)
    crease = low[low[:, 1] < HEIGHT + 1e-3]
    assert len(np.unique(np.round(crease, 5), axis=0)) == len(crease)
