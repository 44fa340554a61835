"""bsmap simulate by its entry point."""

import pytest
from commands import assert_refused, bsmap, left_over, process

from bsmap_cli.io.log import read_log
from bsmap_cli.io.mesh_ply import read_mesh
from bsmap_cli.io.tum import read_tum


def test_log_and_truth_are_written_once_and_again_when_something_changed(tmp_path):
    log = tmp_path / "lab.mcap"
    done = process("simulate", "room", "-o", log)
    assert done.code == 0
    assert done.out == ""
    names = ["lab.mcap", "lab.truth.ply", "lab.truth.tum"]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert len(read_log(log).horizontal.time_ns) == 131
    assert len(read_tum(tmp_path / "lab.truth.tum").time_ns) > 131
    assert len(read_mesh(tmp_path / "lab.truth.ply")[1]) > 10
    first = [(tmp_path / name).read_bytes() for name in names]
    assert "up to date" in bsmap("simulate", "room", "-o", log).err
    assert "up to date" not in bsmap("simulate", "room", "-o", log, "--force").err
    assert [(tmp_path / name).read_bytes() for name in names] == first
    assert "up to date" not in bsmap("simulate", "room", "-o", log, "--seed", "1").err
    assert (tmp_path / "lab.mcap").read_bytes() != first[0]
    assert (tmp_path / "lab.truth.ply").read_bytes() != first[1]  # the seed is in its provenance
    assert left_over(tmp_path) == []


def test_default_output_is_named_by_the_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert bsmap("simulate", "room", "--range-sigma", "0").code == 0
    assert (tmp_path / "room.mcap").exists()


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["cellar"], 2, "scene 'cellar' is not one of room, corridor, loop"),
        (["room", "--rate", "0"], 2, "rate: 0.0 is outside [0.1, 100.0]"),
        (["room", "--seed", "x"], 2, "'x' is not a valid integer"),
        ([], 2, "Missing argument"),
        (["room", "-o", "no/such/x.mcap"], 73, "there is no folder"),
    ],
)
def test_what_it_refuses(tmp_path, monkeypatch, words, code, message):
    monkeypatch.chdir(tmp_path)
    assert_refused(bsmap("simulate", *words), code, message)
    assert list(tmp_path.iterdir()) == []
