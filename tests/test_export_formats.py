"""Every format is read by a program that did not write it, holds the same triangles, and has the same bytes twice."""

import dataclasses
import io
import json

import numpy as np
import plyfile
import pytest
import trimesh
from scipy.interpolate import NdBSpline
from test_export_tessellation import box_map, rough_surface

from bsmap_cli import open3d_loader
from bsmap_cli.core.bspline import evaluate_grid
from bsmap_cli.errors import BadInputError, ParameterError
from bsmap_cli.export import ENDINGS, choose_format, export_map
from bsmap_cli.export.meshes import T_GLTF_MAP
from bsmap_cli.export.product import make_meshes
from bsmap_cli.io.artifact import Provenance, is_up_to_date, read_provenance
from bsmap_cli.model import SurfaceMap
from bsmap_cli.params import ExportParams

FINGERPRINT = "0123456789abcdef" * 3 + "01234567"
PROVENANCE = Provenance("export", "0.1.0", {"tolerance": 0.01}, (("a.map.json", "0" * 64),), FINGERPRINT)


@pytest.fixture(scope="module")
def room():
    """Six flat surfaces and a bumpy one."""
    box = box_map()
    return SurfaceMap((*box.surfaces, rough_surface(3, 3)), box.data_sets)


@pytest.fixture(scope="module")
def meshes(room):
    return make_meshes(room, 0.01)


def exported(room, file_format, tolerance=0.01):
    return export_map(room, file_format, ExportParams(tolerance), provenance=PROVENANCE.to_dict())


def triangle_soup(named_meshes):
    return np.concatenate([mesh.vertices[mesh.triangles] for _, mesh in named_meshes])


def assert_same_triangles(got, wanted, atol):
    np.testing.assert_allclose(np.asarray(got), wanted, atol=atol, rtol=0)


def test_ply_holds_the_triangles_in_double_with_surface_numbers(room, meshes):
    ply = plyfile.PlyData.read(io.BytesIO(exported(room, "ply")))
    vertices = np.stack([ply["vertex"][c] for c in "xyz"], 1)
    triangles = np.stack(ply["face"]["vertex_indices"])
    assert np.array_equal(vertices[triangles], triangle_soup(meshes))
    counts = np.bincount(ply["face"]["surface"])
    assert counts.tolist() == [len(mesh.triangles) for _, mesh in meshes]
    names = [line.split(maxsplit=2)[2] for line in ply.comments if line.startswith("surface ")]
    assert names == [name for name, _ in meshes]


def test_ply_normals_agree_with_the_triangles(room):
    ply = plyfile.PlyData.read(io.BytesIO(exported(room, "ply")))
    normals = np.stack([ply["vertex"]["n" + c] for c in "xyz"], 1)
    vertices = np.stack([ply["vertex"][c] for c in "xyz"], 1)
    a, b, c = np.moveaxis(vertices[np.stack(ply["face"]["vertex_indices"])], 1, 0)
    first = np.stack(ply["face"]["vertex_indices"])[:, 0]
    assert np.all(np.einsum("nd,nd->n", np.cross(b - a, c - a), normals[first]) > 0)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)


def test_ply_is_read_by_trimesh(room, meshes):
    mesh = trimesh.load(io.BytesIO(exported(room, "ply")), file_type="ply", process=False)
    assert_same_triangles(mesh.triangles, triangle_soup(meshes), 1e-6)


@pytest.mark.parametrize("length", [100, 3000])
def test_ply_has_no_line_too_long_for_other_readers(room, tmp_path, length):
    provenance = dataclasses.replace(PROVENANCE, figures={"long": "x" * length})
    (tmp_path / "map.ply").write_bytes(export_map(room, "ply", provenance=provenance.to_dict()))
    header = (tmp_path / "map.ply").read_bytes().split(b"end_header\n")[0]
    assert max(len(line) for line in header.splitlines()) < 512
    assert read_provenance(tmp_path / "map.ply") == provenance


def test_stl_holds_the_triangles(room, meshes):
    mesh = trimesh.load(io.BytesIO(exported(room, "stl")), file_type="stl", process=False)
    assert_same_triangles(mesh.triangles, triangle_soup(meshes), 1e-6)


def test_obj_holds_one_object_a_surface(room, meshes):
    text = exported(room, "obj").decode()
    assert [line[2:] for line in text.splitlines() if line.startswith("o ")] == [name for name, _ in meshes]
    loaded = trimesh.load(io.StringIO(text), file_type="obj", process=False, split_objects=True)
    assert len(loaded.geometry) == len(meshes)
    assert_same_triangles(plain_obj_triangles(text), triangle_soup(meshes), 1e-7)


def plain_obj_triangles(text):
    """Triangles by the letter of the format: numbers count vertices of the whole file from 1."""
    lines = [line.split() for line in text.splitlines()]
    vertices = np.array([words[1:4] for words in lines if words[:1] == ["v"]], dtype=float)
    faces = [[int(word.split("/")[0]) - 1 for word in words[1:]] for words in lines if words[:1] == ["f"]]
    return vertices[np.array(faces)]


def test_glb_holds_one_node_a_surface_with_y_up(room, meshes):
    scene = trimesh.load(io.BytesIO(exported(room, "glb")), file_type="glb", process=False)
    assert sorted(scene.graph.nodes_geometry) == sorted(name for name, _ in meshes)
    for name, mesh in meshes:
        transform, geometry = scene.graph[name]
        np.testing.assert_allclose(transform, T_GLTF_MAP, atol=1e-12)
        assert_same_triangles(scene.geometry[geometry].triangles, mesh.vertices[mesh.triangles], 1e-6)
    up = T_GLTF_MAP @ [0, 0, 1, 0]
    assert up.tolist() == [0, 1, 0, 0]


def test_geomdl_layout_gives_the_same_surface(room):
    """Evaluated by scipy from the JSON alone, by the layout of geomdl 5: points count along v first."""
    data = json.loads(exported(room, "geomdl"))["shape"]
    assert data["type"] == "surface"
    assert data["count"] == len(data["data"]) == len(room.surfaces)
    u, v = np.linspace(0, 1, 7), np.linspace(0, 1, 5)
    at = np.stack(np.meshgrid(u, v, indexing="ij"), 2)
    for entry, surface in zip(data["data"], room.surfaces, strict=True):
        points = np.reshape(entry["control_points"]["points"], (entry["size_u"], entry["size_v"], 3))
        knots = np.array(entry["knotvector_u"]), np.array(entry["knotvector_v"])
        spline = NdBSpline(knots, points, (entry["degree_u"], entry["degree_v"]))
        np.testing.assert_allclose(spline(at), evaluate_grid(surface, u, v), atol=1e-12)


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::SyntaxWarning")
def test_geomdl_reads_its_layout(room, tmp_path):
    exchange = pytest.importorskip("geomdl.exchange")
    (tmp_path / "map.json").write_bytes(exported(room, "geomdl"))
    for read, surface in zip(exchange.import_json(str(tmp_path / "map.json")), room.surfaces, strict=True):
        assert read.name == surface.name
        np.testing.assert_allclose(
            read.evaluate_single((0.3, 0.6)), evaluate_grid(surface, [0.3], [0.6])[0, 0], atol=1e-12
        )


@pytest.mark.parametrize("ending", ENDINGS)
def test_file_carries_its_fingerprint_and_is_whole(room, tmp_path, ending):
    path = tmp_path / f"map{ending}"
    path.write_bytes(exported(room, ENDINGS[ending]))
    assert is_up_to_date(path, FINGERPRINT)
    if ending != ".stl":
        assert read_provenance(path) == PROVENANCE
    path.write_bytes(path.read_bytes()[:-9])
    assert ending == ".ply" or not is_up_to_date(path, FINGERPRINT)


@pytest.mark.parametrize("file_format", ENDINGS.values())
def test_same_map_gives_the_same_bytes(room, file_format):
    assert exported(room, file_format) == exported(room, file_format)


@pytest.mark.parametrize("file_format", ["ply", "obj", "stl", "glb"])
def test_finer_tolerance_gives_a_larger_file(room, file_format):
    assert len(exported(room, file_format, 0.001)) > len(exported(room, file_format, 0.05))


@pytest.mark.parametrize("file_format", ENDINGS.values())
def test_export_without_provenance_needs_none(room, file_format):
    assert b"fingerprint" not in export_map(room, file_format)


def test_format_follows_the_ending_unless_named():
    assert choose_format("a/map.GLB") == "glb"
    assert choose_format("map.json") == "geomdl"
    assert choose_format("map.txt", "OBJ") == "obj"


def test_unknown_ending_lists_the_formats():
    with pytest.raises(
        ParameterError, match=r"map\.step: no format has the ending '\.step'.*ply.*obj.*stl.*glb.*geomdl"
    ):
        choose_format("map.step")
    with pytest.raises(ParameterError, match=r"format 'dxf' is unknown; there are ply"):
        choose_format("map.ply", "dxf")


def test_map_without_surfaces_is_refused():
    with pytest.raises(BadInputError, match="no surface"):
        export_map(SurfaceMap((), ()), "ply")


def test_open3d_reads_the_meshes(room, meshes, tmp_path):
    open3d = open3d_loader.load()
    for ending in (".ply", ".stl", ".obj", ".glb"):
        (tmp_path / f"map{ending}").write_bytes(exported(room, ENDINGS[ending]))
        mesh = open3d.io.read_triangle_mesh(str(tmp_path / f"map{ending}"))
        assert len(mesh.triangles) == len(triangle_soup(meshes)), ending
