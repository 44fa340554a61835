"""The formats, and the stage's function: a map in, the bytes of a file out."""

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from bsmap_cli.errors import BadInputError, ParameterError
from bsmap_cli.export.meshes import WRITERS, NamedMesh
from bsmap_cli.export.nurbs_json import write_nurbs_json
from bsmap_cli.export.orientation import turned, viewpoints
from bsmap_cli.export.tessellation import tessellate_map
from bsmap_cli.model import SurfaceMap
from bsmap_cli.params import ExportParams
from bsmap_cli.track import Track, silent

ENDINGS = {".ply": "ply", ".obj": "obj", ".stl": "stl", ".glb": "glb", ".json": "geomdl"}
"""Ending of a file -> name of its format."""


def choose_format(path: PurePath | str, name: str | None = None) -> str:
    """Format by its name if there is one, else by the file's ending; ParameterError lists them all."""
    known = ", ".join(f"{format} ({ending})" for ending, format in ENDINGS.items())
    if name is not None:
        if name.lower() in ENDINGS.values():
            return name.lower()
        raise ParameterError(f"format {name!r} is unknown; there are {known}")
    ending = PurePath(path).suffix.lower()
    if ending in ENDINGS:
        return ENDINGS[ending]
    raise ParameterError(f"{path}: no format has the ending {ending!r}; there are {known}; or name one with --format")


def export_map(
    surface_map: SurfaceMap,
    file_format: str,
    params: ExportParams | None = None,
    *,
    provenance: Mapping[str, Any] | None = None,
    track: Track = silent,
) -> bytes:
    """Bytes of a file that holds the map's surfaces, in map coordinates, metres.

    Parameters
    ----------
    surface_map : of data sets or merged.
    file_format : a value of `ENDINGS`. "ply" and "stl" hold one mesh, "obj" and "glb" one object a surface, "geomdl"
        the surfaces themselves.
    provenance : plain JSON types, as `Provenance.to_dict()` gives them; it is stored near the start of the file.

    Raises
    ------
    BadInputError
        The map holds no surface.
    ParameterError
        The format is unknown, or the tolerance is too fine for the surfaces.
    """
    params = params or ExportParams()
    file_format = choose_format("", file_format)
    if not surface_map.surfaces:
        raise BadInputError("the map holds no surface, so there is nothing to export")
    if file_format == "geomdl":
        return write_nurbs_json(surface_map.surfaces, provenance)
    return WRITERS[file_format](make_meshes(surface_map, params.tolerance, track=track), provenance)


def make_meshes(surface_map: SurfaceMap, tolerance: float, *, track: Track = silent) -> list[NamedMesh]:
    """Triangles of every surface, within `tolerance` metres of it, their front towards the sensor."""
    seen_from = viewpoints(surface_map)
    made = tessellate_map(surface_map, tolerance, track=track)
    return [
        NamedMesh(surface.name, turned(mesh, surface, seen_from))
        for surface, mesh in zip(surface_map.surfaces, made, strict=True)
        if len(mesh.triangles)
    ]
