"""Triangle meshes of known scenes as PLY: the truth beside a simulated log."""

from pathlib import Path

import numpy as np

from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance, atomic_output, split_comment
from bsmap_cli.model import Array, IntArray


def write_mesh(path: Path | str, vertices: Array, triangles: IntArray, provenance: Provenance | None = None) -> None:
    """Binary PLY of vertices (n, 3), metres, and triangles (m, 3); CannotWriteError where that fails."""
    from plyfile import PlyData, PlyElement

    points = np.empty(len(vertices), dtype=[("x", "f8"), ("y", "f8"), ("z", "f8")])
    points["x"], points["y"], points["z"] = vertices.T
    faces = np.empty(len(triangles), dtype=[("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = triangles
    elements = [PlyElement.describe(points, "vertex"), PlyElement.describe(faces, "face")]
    comments = split_comment(provenance.to_line()) if provenance else []
    with atomic_output(path) as temporary:
        PlyData(elements, byte_order="<", comments=comments).write(str(temporary))


def read_mesh(path: Path | str) -> tuple[Array, IntArray]:
    """Vertices (n, 3) and triangles (m, 3) of a PLY file.

    Raises MissingInputError where it cannot be opened, BadInputError where it is no PLY file of triangles.
    """
    from plyfile import PlyData, PlyParseError

    try:
        data = PlyData.read(str(path))
        points, faces = data["vertex"].data, data["face"].data["vertex_indices"]
        triangles = np.stack([np.asarray(f) for f in faces]).astype(np.int64)
        vertices = np.stack([points["x"], points["y"], points["z"]], axis=1).astype(float)
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error
    except (PlyParseError, KeyError, ValueError) as error:
        raise BadInputError(f"{path}: not a PLY file of triangles: {error}") from error
    if triangles.shape[1] != 3:
        raise BadInputError(f"{path}: has faces of {triangles.shape[1]} corners; triangles are wanted")
    return vertices, triangles
