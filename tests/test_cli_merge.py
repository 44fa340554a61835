"""bsmap merge by its entry point."""

import shutil
from pathlib import Path

import pytest
from commands import assert_caches, assert_refused, assert_usual_refusals, bsmap, left_over, process
from face_maps import boxed, put, room

from bsmap_cli.io.artifact import read_provenance
from bsmap_cli.io.surfaces_json import read_surfaces, write_surfaces
from bsmap_cli.merge.placed import placed


@pytest.fixture(scope="module")
def coarse(made: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Surfaces of few control points, quickly merged."""
    path = tmp_path_factory.mktemp("coarse") / "log.surfaces.json"
    assert bsmap("fit", made / "log.cloud.ply", "--bound-u", "0.2", "--bound-v", "0.5", "-o", path).code == 0
    return path


@pytest.fixture
def surfaces(coarse: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(coarse, tmp_path))


def test_map_lies_beside_the_surfaces_and_tells_its_decisions(surfaces):
    done = process("merge", surfaces)
    assert done.code == 0
    assert done.out == ""
    output = surfaces.with_name("log.map.json")
    merged = read_surfaces(output)
    assert {decision.outcome for decision in merged.decisions} <= {"merged", "refused"}
    assert read_provenance(output).figures["merged"] == sum(d.outcome == "merged" for d in merged.decisions)
    assert f"{output}: surfaces {len(merged.surfaces)}" in done.err


def test_it_is_made_once_and_again_when_something_changed(surfaces):
    assert_caches(["merge", surfaces], surfaces.with_name("log.map.json"), ["--distance", "0.05"])


def test_several_inputs_make_one_map_named_by_the_first(surfaces, tmp_path):
    other = Path(shutil.copy(surfaces, tmp_path / "other.surfaces.json"))
    done = bsmap("merge", surfaces, other)
    assert done.code == 0, done
    names = [name for name, _ in read_provenance(tmp_path / "log.map.json").inputs]
    assert names == ["log.surfaces.json", "other.surfaces.json"]
    assert not (tmp_path / "other.map.json").exists()


def test_survey_folded_into_a_map_names_the_new_one(surfaces, tmp_path):
    old, new = tmp_path / "old.map.json", tmp_path / "new.surfaces.json"
    new.write_bytes(surfaces.read_bytes())
    assert bsmap("merge", surfaces, "-o", old).code == 0
    assert bsmap("merge", old, new).code == 0
    before, after = read_surfaces(old), read_surfaces(tmp_path / "new.map.json")
    assert [d.name for d in after.data_sets] == [d.name for d in before.data_sets]
    assert len(after.surfaces) == len(before.surfaces)
    assert {s.name for s in after.surfaces} >= {s.name for s in before.surfaces if len(s.data_sets) > 1}


@pytest.fixture
def elsewhere(tmp_path):
    """Surfaces in a frame of their own, beside others of the same room."""
    write_surfaces(tmp_path / "here.surfaces.json", room("set-01"))
    path = tmp_path / "there.surfaces.json"
    write_surfaces(path, placed(room("set-02", 0.001, 2), put(3.0, -5.0, 120.0)))
    return path


def test_maps_of_different_origin_are_brought_together(elsewhere, tmp_path):
    output, picture = tmp_path / "here.map.json", tmp_path / "a.png"
    command = ["merge", tmp_path / "here.surfaces.json", elsewhere, "--align"]
    done = bsmap(*command, "--plot", picture)
    assert done.code == 0, done
    (placement,) = read_surfaces(output).placements
    name = ("here", "there")[placement.survey] + ".surfaces.json"
    assert f"placed {name} at x " in done.err
    assert "unique: rival" in done.err
    assert f"placed {name}: at x " in bsmap("info", output).out
    first = output.read_bytes(), picture.read_bytes()
    assert bsmap(*command, "--plot", picture, "--force").code == 0
    assert (output.read_bytes(), picture.read_bytes()) == first
    assert "up to date" in bsmap(*command).err


def test_map_that_cannot_be_brought_together_with_others_is_named(elsewhere, tmp_path):
    write_surfaces(elsewhere, boxed("set-02", (0.0, 0.0, 0.0), (1.2, 0.9, 2.5)))
    done = bsmap("merge", tmp_path / "here.surfaces.json", elsewhere, "--align")
    assert_refused(done, 3, ".surfaces.json: ", "they do not overlap")
    assert not (tmp_path / "here.map.json").exists()


def test_what_it_refuses(surfaces, tmp_path):
    assert_usual_refusals("merge", surfaces, tmp_path)
    assert_refused(bsmap("merge", surfaces, tmp_path / "gone.json"), 66, "gone.json: no such file")
    assert_refused(bsmap("merge", surfaces, "--gate", "0.1"), 2, "gate: 0.1 is outside")
    assert_refused(bsmap("merge", surfaces, "--align"), 2, "align: one map alone")


@pytest.mark.parametrize("ending", [".png", ".svg", ".pdf"])
def test_picture_is_the_same_when_made_at_once_and_from_the_artifact(surfaces, ending):
    one, two = surfaces.with_name("one" + ending), surfaces.with_name("two" + ending)
    assert f"{one}: picture" in bsmap("merge", surfaces, "--plot", one).err
    made = surfaces.with_name("log.map.json").read_bytes()
    assert "up to date" in bsmap("merge", surfaces, "--plot", two).err
    assert surfaces.with_name("log.map.json").read_bytes() == made
    assert one.read_bytes() == two.read_bytes()
    assert one.read_bytes().startswith({".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[ending])
    assert left_over(surfaces.parent) == []


def test_picture_of_several_inputs_that_share_names(surfaces, tmp_path):
    other = Path(shutil.copy(surfaces, tmp_path / "other.surfaces.json"))
    assert bsmap("merge", surfaces, other, "--plot", tmp_path / "a.png").code == 0
    assert (tmp_path / "a.png").stat().st_size > 10_000


def test_picture_that_cannot_be_made_is_refused_before_the_work(surfaces):
    name = surfaces.with_name("a.gif")
    assert_refused(bsmap("merge", surfaces, "--plot", name), 2, "a.gif: pictures are made as .png")
    assert_refused(bsmap("merge", surfaces, "--plot", surfaces), 2, "pictures are made as .png")
    assert not surfaces.with_name("log.map.json").exists()
