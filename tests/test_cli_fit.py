"""bsmap fit by its entry point."""

import shutil
from pathlib import Path

import pytest
from commands import assert_caches, assert_refused, assert_usual_refusals, bsmap, process

from bsmap_cli.io.artifact import read_provenance
from bsmap_cli.io.surfaces_json import read_surfaces


@pytest.fixture
def cloud(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(made / "log.cloud.ply", tmp_path))


def test_surfaces_lie_beside_the_cloud(cloud):
    done = process("fit", cloud)
    assert done.code == 0
    assert done.out == ""
    output = cloud.with_name("log.surfaces.json")
    surfaces = read_surfaces(output)
    assert [data_set.movement for data_set in surfaces.data_sets] == ["translation", "rotation"]
    assert f"{output}: surfaces {len(surfaces.surfaces)}" in done.err
    assert read_provenance(output).figures["surfaces"] == len(surfaces.surfaces)


def test_it_is_made_once_and_again_when_something_changed(cloud):
    assert_caches(["fit", cloud], cloud.with_name("log.surfaces.json"), ["--bound-u", "0.05"])


def test_options_reach_the_fit(cloud, tmp_path):
    options = ("--method", "paper", "--degree-u", "1", "--degree-v", "2")
    assert bsmap("fit", cloud, *options, "-o", tmp_path / "flat.json").code == 0
    assert {(s.degree_u, s.degree_v) for s in read_surfaces(tmp_path / "flat.json").surfaces} == {(1, 2)}


def test_faces_are_the_default_and_trimmed(cloud, tmp_path):
    assert bsmap("fit", cloud, "-o", tmp_path / "faces.json").code == 0
    surface_map = read_surfaces(tmp_path / "faces.json")
    assert len(surface_map.surfaces) > len(surface_map.data_sets)
    assert all(surface.trims for surface in surface_map.surfaces)


def test_what_it_refuses(cloud, tmp_path):
    assert_usual_refusals("fit", cloud, tmp_path)
    assert_refused(bsmap("fit", cloud, "--degree-u", "9"), 2, "degree_u: 9 is outside [1, 7]")


def test_mesh_instead_of_cloud_is_refused(made):
    assert_refused(bsmap("fit", made / "log.truth.ply", "-o", made / "never.json"), 65, "log.truth.ply")
