"""bsmap export by its entry point."""

import json
import shutil
from pathlib import Path

import pytest
import trimesh
from commands import assert_caches, assert_refused, bsmap, left_over, process

from bsmap_cli.io.artifact import read_fingerprint
from bsmap_cli.io.surfaces_json import read_surfaces


@pytest.fixture
def whole(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(made / "log.map.json", tmp_path))


def test_several_files_at_once_one_a_format(whole, tmp_path):
    files = [tmp_path / f"map.{ending}" for ending in ("ply", "obj", "stl", "glb", "nurbs.json")]
    done = process("export", whole, *(word for path in files for word in ("--to", path)))
    assert done.code == 0
    assert done.out == ""
    surfaces = read_surfaces(whole).surfaces
    triangles = {len(trimesh.load(path, force="mesh").faces) for path in files[:4]}
    assert len(triangles) == 1
    assert triangles.pop() >= 2 * len(surfaces)
    assert len(trimesh.load(files[3]).geometry) == len(surfaces)
    assert len({read_fingerprint(path) for path in files}) == 5 or len({read_fingerprint(path) for path in files}) == 1
    assert json.loads(files[4].read_text())


def test_it_is_made_once_and_again_when_something_changed(whole, tmp_path):
    assert_caches(["export", whole, "--to", tmp_path / "map.ply"], tmp_path / "map.ply", ["--tolerance", "0.05"])


def test_unmerged_surfaces_can_be_exported_too(made, tmp_path):
    assert bsmap("export", made / "log.surfaces.json", "--to", tmp_path / "raw.stl").code == 0


def test_what_it_refuses(whole, tmp_path):
    assert_refused(bsmap("export", whole), 2, "Missing option '--to'")
    assert_refused(bsmap("export", whole, "--to", tmp_path / "map.xyz"), 2, "map.xyz")
    assert_refused(bsmap("export", whole, "--to", whole), 2, "is the input")
    assert_refused(bsmap("export", whole, "--to", tmp_path / "no" / "map.ply"), 73, "there is no folder")
    assert_refused(bsmap("export", tmp_path / "gone.json", "--to", tmp_path / "map.ply"), 66, "no such file")
    cut = tmp_path / "cut.map.json"
    cut.write_bytes(whole.read_bytes()[:2000])
    assert_refused(bsmap("export", cut, "--to", tmp_path / "map.ply"), 65, "cut.map.json")
    assert not (tmp_path / "map.ply").exists()
    assert left_over(tmp_path) == []
