"""Clouds of other programs: every kind of PLY gives the same points, and each refusal says why."""

from pathlib import Path

import numpy as np
import pytest
from scattered import write_ply

from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance
from bsmap_cli.io.mesh_ply import write_mesh
from bsmap_cli.io.points_ply import is_organised, read_points

POINTS = np.random.default_rng(3).normal(size=(50, 3))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["float", "double"])
def test_every_form_gives_the_points(tmp_path: Path, form: str, kind: str) -> None:
    path = write_ply(tmp_path / "a.ply", POINTS, kind, form)
    assert not is_organised(path)
    exact = POINTS if kind == "double" else POINTS.astype(np.float32).astype(float)
    np.testing.assert_array_equal(read_points(path).points, exact)


def test_mesh_of_another_program_is_no_cloud(tmp_path: Path) -> None:
    write_mesh(tmp_path / "mesh.ply", POINTS, np.array([[0, 1, 2]]))
    with pytest.raises(BadInputError, match="is a mesh; wanted a cloud of points"):
        read_points(tmp_path / "mesh.ply")
    write_mesh(tmp_path / "points.ply", POINTS, np.zeros((0, 3), dtype=int))
    np.testing.assert_array_equal(read_points(tmp_path / "points.ply").points, POINTS)


def test_lines_that_end_as_on_windows_are_read(tmp_path: Path) -> None:
    path = write_ply(tmp_path / "a.ply", POINTS, "double", "ascii")
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    np.testing.assert_array_equal(read_points(path).points, POINTS)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("share", [0.02, 0.3, 0.6, 0.9])
def test_cut_file_is_refused(tmp_path: Path, form: str, share: float) -> None:
    path = write_ply(tmp_path / "a.ply", POINTS, form=form)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(BadInputError, match=r"a\.ply: "):
        read_points(path)


def header(lines: str) -> bytes:
    return f"ply\nformat ascii 1.0\n{lines}end_header\n".encode()


XYZ = "property float x\nproperty float y\nproperty float z\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not a PLY file"),
        (b"plywood", "is not a PLY file"),
        (b"ply\n", "is damaged or was cut"),
        (header(f"element vertex 0\n{XYZ}"), "has 0 points, wanted 30 or more"),
        (header(f"element vertex 3\n{XYZ}") + 3 * b"1 2 3\n", "has 3 points, wanted 30 or more"),
        (header("element face 0\nproperty list uchar int vertex_indices\n"), "its elements are: face"),
        (header("element vertex 1\nproperty float x\nproperty float y\n") + b"1 2\n", "its points have no z"),
        (header(f"element vertex 99999999999\n{XYZ}") + 3 * b"1 2 3\n", "was cut"),
        (header(f"element vertex many\n{XYZ}"), "is damaged"),
        (header(f"element vertex 1\n{XYZ}") + b"1 2 what\n", "is damaged or was cut"),
        (header(f"element vertex 1\n{XYZ}").replace(b"ascii", b"morse"), "cut"),
    ],
)
def test_refusals_say_why(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(content)
    with pytest.raises(BadInputError, match=message):
        read_points(path)


def test_points_that_are_not_finite_are_counted(tmp_path: Path) -> None:
    points = POINTS.copy()
    points[7, 1], points[9, 2] = np.nan, np.inf
    with pytest.raises(BadInputError, match="2 points are not finite, the first is number 7"):
        read_points(write_ply(tmp_path / "a.ply", points))


def test_coordinates_beyond_the_earth_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="wanted metres"):
        read_points(write_ply(tmp_path / "a.ply", POINTS * 1e12))


def test_what_another_stage_made_is_named(tmp_path: Path) -> None:
    made = Provenance("simulate room", "0.1.0", {}, (), "c" * 56, {})
    write_mesh(tmp_path / "truth.ply", POINTS, np.array([[0, 1, 2]]), made)
    with pytest.raises(BadInputError, match="was made by `bsmap simulate room` and is no cloud"):
        read_points(tmp_path / "truth.ply")


def test_missing_file_is_told(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="No such file"):
        read_points(tmp_path / "none.ply")
