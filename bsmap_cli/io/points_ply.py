"""Clouds of other programs: PLY files, text or binary, of which the coordinates x, y, z of the vertices are read."""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyParseError

from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import join_comments, read_provenance
from bsmap_cli.io.completeness import ply_size
from bsmap_cli.model import ScatteredCloud

FEWEST = 30
"""Points of a cloud."""
FARTHEST = 1e8
"""Metres from the origin; beyond it a coordinate is no place on the Earth, and millimetres are lost."""


def is_organised(path: Path | str) -> bool:
    """Whether a file says of itself that it is a cloud of `bsmap cloud`; MissingInputError where it is not there."""
    return (
        re.search(r"^comment bsmap-cloud:", join_comments(_head(Path(path)).decode("latin-1")), re.MULTILINE)
        is not None
    )


def read_points(path: Path | str) -> ScatteredCloud:
    """Read the points of any PLY file; metres are taken for granted.

    Raises
    ------
    MissingInputError
        There is no such file.
    BadInputError
        It is no PLY file, was cut, is damaged, has no x, y, z, too few points or such as are not finite; it is a
        mesh, or was made by another stage of bsmap.
    """
    path = Path(path)
    head = _head(path)
    if not re.match(rb"ply\r?\n", head):
        raise BadInputError(f"{path}: is not a PLY file; wanted a cloud of points")
    made = read_provenance(path)
    if made is not None:
        raise BadInputError(f"{path}: was made by `bsmap {made.stage}` and is no cloud; wanted a cloud of points")
    _check_size(path, head)
    points = _coordinates(path, _vertices(path))
    if len(points) < FEWEST:
        raise BadInputError(f"{path}: has {len(points)} points, wanted {FEWEST} or more")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise BadInputError(
            f"{path}: {len(bad)} points are not finite, the first is number {bad[0]} (from 0); remove them"
        )
    if (largest := float(np.abs(points).max())) > FARTHEST:
        raise BadInputError(f"{path}: a coordinate is {largest:.3g} m; wanted metres, {FARTHEST:g} at the most")
    return ScatteredCloud(points)


def _head(path: Path) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(65536)
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error


def _check_size(path: Path, head: bytes) -> None:
    """Refuse a file that was cut, before memory is asked for by what its header says."""
    size = path.stat().st_size
    try:
        wanted = ply_size(head)
        counts = [int(n) for n in re.findall(rb"^element \S+ +(\d+)", head, re.MULTILINE)]
    except (ValueError, IndexError) as error:
        raise BadInputError(f"{path}: its header is damaged ({error})") from error
    if wanted is not None and wanted > size:
        raise BadInputError(f"{path}: was cut: {size} bytes, wanted {wanted}")
    if sum(counts) > size:
        raise BadInputError(f"{path}: was cut: {size} bytes cannot hold {sum(counts)} elements")


def _vertices(path: Path) -> NDArray[Any]:
    try:
        elements = PlyData.read(str(path))
    except (PlyParseError, ValueError, KeyError, IndexError, TypeError, OverflowError) as error:
        raise BadInputError(f"{path}: is damaged or was cut ({error})") from error
    if any(element.name == "face" and len(element.data) for element in elements):
        raise BadInputError(f"{path}: is a mesh; wanted a cloud of points, without the element face")
    found = [element.data for element in elements if element.name == "vertex"]
    if not found:
        names = ", ".join(element.name for element in elements) or "none"
        raise BadInputError(f"{path}: has no points: wanted the element vertex, its elements are: {names}")
    return found[0]


def _coordinates(path: Path, rows: NDArray[Any]) -> NDArray[np.float64]:
    names = rows.dtype.names or ()
    if missing := [name for name in "xyz" if name not in names or rows.dtype[name].kind not in "iuf"]:
        raise BadInputError(
            f"{path}: its points have no {', '.join(missing)}; their properties are: {', '.join(names)}"
        )
    return np.column_stack([rows[name].astype(np.float64) for name in "xyz"])
