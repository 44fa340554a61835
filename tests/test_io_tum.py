"""Trajectories as text, and meshes of known scenes."""

from pathlib import Path

import numpy as np
import pytest

from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io.artifact import Provenance, read_provenance
from bsmap_cli.io.completeness import is_complete
from bsmap_cli.io.mesh_ply import read_mesh, write_mesh
from bsmap_cli.io.tum import read_tum, write_tum
from bsmap_cli.model import Trajectory

START = 1_700_000_000_123_456_789
MADE = Provenance("slam", "0.1.0", {}, (("log.mcap", "0" * 64),), "d" * 56, {})


def trajectory(n: int = 50) -> Trajectory:
    rng = np.random.default_rng(2)
    return Trajectory(START + np.cumsum(rng.integers(-5, 10**9, n)), rng.normal(size=(n, 3)), np.zeros((n, 3, 3)))


def test_stamps_are_exact_and_poses_to_a_nanometre(tmp_path: Path) -> None:
    made = trajectory()
    write_tum(tmp_path / "a.tum", made, MADE)
    read = read_tum(tmp_path / "a.tum")
    np.testing.assert_array_equal(read.time_ns, made.time_ns)
    np.testing.assert_allclose(read.poses, made.poses, atol=1e-9)
    assert read_provenance(tmp_path / "a.tum") == MADE
    assert np.loadtxt(tmp_path / "a.tum").shape == (50, 8)


def test_same_trajectory_same_bytes_and_a_cut_one_is_seen(tmp_path: Path) -> None:
    for name in ("a.tum", "b.tum"):
        write_tum(tmp_path / name, trajectory())
    content = (tmp_path / "a.tum").read_bytes()
    assert content == (tmp_path / "b.tum").read_bytes()
    assert is_complete(tmp_path / "a.tum")
    (tmp_path / "a.tum").write_bytes(content[: content.rindex(b"\n", 0, -1) + 1])
    assert not is_complete(tmp_path / "a.tum")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "holds no poses"),
        ("# only\n", "holds no poses"),
        ("1 2 3\n", "line 1: 3 columns; wanted t x y z"),
        ("# c\n1 0 0 0 0 0 0 1\n1 0 0 0 0 0 x 1\n", "line 3: could not convert"),
        ("1 nan 0 0 0 0 0 1\n", "line 1: not a pose"),
        ("1 0 0 0 0 0 0 0\n", "line 1: not a pose"),
        ("t 0 0 0 0 0 0 1\n", "line 1: "),
    ],
)
def test_what_is_no_trajectory_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.tum").write_text(text)
    with pytest.raises(BadInputError, match=message):
        read_tum(tmp_path / "a.tum")


def test_missing_trajectory(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match="No such file"):
        read_tum(tmp_path / "a.tum")


def test_mesh_comes_back_with_provenance(tmp_path: Path) -> None:
    vertices, triangles = np.random.default_rng(0).normal(size=(4, 3)), np.array([[0, 1, 2], [1, 2, 3]])
    path = tmp_path / "a.ply"
    write_mesh(path, vertices, triangles, MADE)
    read_vertices, read_triangles = read_mesh(path)
    np.testing.assert_array_equal(read_vertices, vertices)
    np.testing.assert_array_equal(read_triangles, triangles)
    assert read_provenance(path) == MADE
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(BadInputError, match="not a PLY file of triangles"):
        read_mesh(path)
    with pytest.raises(MissingInputError, match="No such file"):
        read_mesh(tmp_path / "none.ply")
