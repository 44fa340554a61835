"""Mesh files: PLY, OBJ, STL and GLB, the same bytes for the same meshes."""

import json
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from bsmap_cli.export.tessellation import Mesh
from bsmap_cli.model import Array

KEY = "bsmap-provenance"

# glTF's y points up, the map's z: the root node turns one into the other, the vertices stay in map.
T_GLTF_MAP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])

COMMENT_WIDTH = 400
"""Longest comment of a PLY: MeshLab's reader takes lines of 511 characters, that of Open3D crashes at 1024."""


class NamedMesh(NamedTuple):
    """Mesh of the surface `name`."""

    name: str
    mesh: Mesh


def vertex_normals(mesh: Mesh) -> Array:
    """(n, 3) unit normals: those of the triangles around a vertex, weighted by their area."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.triangles], 1, 0)
    of_triangles = np.cross(b - a, c - a)
    normals = np.zeros_like(mesh.vertices)
    for corner in range(3):
        np.add.at(normals, mesh.triangles[:, corner], of_triangles)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0.0, length, 1.0)


def provenance_line(provenance: Mapping[str, Any]) -> str:
    """One line of ASCII for a comment."""
    return f"{KEY}:" + json.dumps(provenance, separators=(",", ":"))


def _ply_comments(provenance: Mapping[str, Any]) -> list[str]:
    """The line in pieces, which `io.artifact.join_comments` joins again."""
    line = provenance_line(provenance)
    pieces = [line[i : i + COMMENT_WIDTH] for i in range(0, len(line), COMMENT_WIDTH)]
    return [pieces[0], *("bsmap+:" + piece for piece in pieces[1:])]


def write_ply(meshes: Sequence[NamedMesh], provenance: Mapping[str, Any] | None) -> bytes:
    """Binary PLY: double x y z, float normals; faces with int `surface`, which the comments give names to."""
    vertices = np.concatenate([_ply_vertices(mesh) for _, mesh in meshes])
    faces = np.concatenate([_ply_faces(mesh, index) for index, (_, mesh) in enumerate(meshes)])
    faces["vertex_indices"] += np.repeat(_offsets(meshes), [len(m.triangles) for _, m in meshes])[:, None]
    comments = _ply_comments(provenance) if provenance else []
    comments += ["frame map, metres", *(f"surface {index} {name}" for index, (name, _) in enumerate(meshes))]
    header = ["ply", "format binary_little_endian 1.0", *(f"comment {c}" for c in comments)]
    header += [f"element vertex {len(vertices)}", *(f"property double {c}" for c in "xyz")]
    header += [f"property float n{c}" for c in "xyz"]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "property int surface"]
    return ("\n".join(header) + "\nend_header\n").encode("ascii") + vertices.tobytes() + faces.tobytes()


def _ply_vertices(mesh: Mesh) -> np.ndarray[Any, Any]:
    rows = np.empty(len(mesh.vertices), dtype=[("position", "<f8", 3), ("normal", "<f4", 3)])
    rows["position"], rows["normal"] = mesh.vertices, vertex_normals(mesh)
    return rows


def _ply_faces(mesh: Mesh, surface: int) -> np.ndarray[Any, Any]:
    dtype = [("count", "u1"), ("vertex_indices", "<i4", 3), ("surface", "<i4")]
    rows = np.empty(len(mesh.triangles), dtype=dtype)
    rows["count"], rows["vertex_indices"], rows["surface"] = 3, mesh.triangles, surface
    return rows


def _offsets(meshes: Sequence[NamedMesh]) -> np.ndarray[Any, Any]:
    """Number of vertices before each mesh."""
    return np.cumsum([0] + [len(mesh.vertices) for _, mesh in meshes[:-1]])


def write_stl(meshes: Sequence[NamedMesh], provenance: Mapping[str, Any] | None) -> bytes:
    """Binary STL of all triangles; its header of 80 bytes holds the fingerprint alone."""
    from trimesh.exchange.stl import export_stl

    vertices = np.concatenate([mesh.vertices for _, mesh in meshes])
    shifted = [mesh.triangles + offset for (_, mesh), offset in zip(meshes, _offsets(meshes), strict=True)]
    title = str(provenance["fingerprint"]) if provenance else "bsmap"
    body = export_stl(_trimesh(NamedMesh("map", Mesh(vertices, np.concatenate(shifted)))))
    return title.encode("ascii").ljust(80)[:80] + body[80:]


def write_obj(meshes: Sequence[NamedMesh], provenance: Mapping[str, Any] | None) -> bytes:
    """OBJ with one object (`o`) a surface, in millionths of a metre and finer."""
    import trimesh
    from trimesh.exchange.obj import export_obj

    scene = trimesh.Scene()
    for named in meshes:
        scene.add_geometry(_trimesh(named), node_name=named.name, geom_name=named.name)
    lines = ([provenance_line(provenance)] if provenance else []) + ["frame map, metres"]
    text = export_obj(
        scene, include_normals=True, include_color=False, include_texture=False, header="\n# ".join(lines)
    )
    return (text.rstrip("\n") + "\n").encode()


def write_glb(meshes: Sequence[NamedMesh], provenance: Mapping[str, Any] | None) -> bytes:
    """Binary glTF 2.0 with one node a surface, under the node `map` that turns z up into glTF's y up."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    scene = trimesh.Scene(base_frame="world")
    scene.graph.update(frame_from="world", frame_to="map", matrix=T_GLTF_MAP)
    for named in meshes:
        scene.add_geometry(_trimesh(named), node_name=named.name, geom_name=named.name, parent_node_name="map")

    def stamp(tree: dict[str, Any]) -> None:
        rest = dict(tree)
        tree.clear()
        tree["asset"] = {"version": "2.0", "generator": "bsmap"}
        if provenance:
            tree["asset"]["extras"] = {KEY: dict(provenance)}
        tree.update({key: value for key, value in rest.items() if key != "asset"})

    return bytes(export_glb(scene, include_normals=True, tree_postprocessor=stamp))


def _trimesh(named: NamedMesh) -> Any:
    import trimesh

    mesh = trimesh.Trimesh(named.mesh.vertices, named.mesh.triangles, process=False, metadata={"name": named.name})
    mesh.vertex_normals = vertex_normals(named.mesh)
    return mesh


WRITERS: dict[str, Callable[[Sequence[NamedMesh], Mapping[str, Any] | None], bytes]] = {
    "ply": write_ply,
    "obj": write_obj,
    "stl": write_stl,
    "glb": write_glb,
}
