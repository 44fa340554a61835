"""bsmap fit by its entry point."""

import shutil
from pathlib import Path

import pytest
from commands import assert_caches, assert_refused, assert_usual_refusals, bsmap, left_over, process

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


@pytest.mark.parametrize("ending", [".png", ".svg", ".pdf"])
def test_picture_is_the_same_when_made_at_once_and_from_the_artifact(cloud, ending):
    one, two = cloud.with_name("one" + ending), cloud.with_name("two" + ending)
    assert f"{one}: picture" in bsmap("fit", cloud, "--plot", one).err
    made = cloud.with_name("log.surfaces.json").read_bytes()
    assert "up to date" in bsmap("fit", cloud, "--plot", two).err
    assert cloud.with_name("log.surfaces.json").read_bytes() == made
    assert one.read_bytes() == two.read_bytes()
    assert one.read_bytes().startswith({".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[ending])
    assert left_over(cloud.parent) == []


def test_pictures_of_the_papers_surfaces(cloud):
    pictures = [cloud.with_name("a.png"), cloud.with_name("b.svg")]
    coarse = ("--method", "paper", "--bound-u", "0.2", "--bound-v", "0.5")
    assert bsmap("fit", cloud, *coarse, "--plot", pictures[0], "--plot", pictures[1]).code == 0
    assert all(path.stat().st_size > 10_000 for path in pictures)


def test_picture_that_cannot_be_made_is_refused_before_the_work(cloud):
    assert_refused(bsmap("fit", cloud, "--plot", cloud.with_name("a.gif")), 2, "a.gif: pictures are made as .png")
    assert_refused(bsmap("fit", cloud, "--plot", cloud.parent / "none" / "a.png"), 73, "there is no folder")
    assert not cloud.with_name("log.surfaces.json").exists()
