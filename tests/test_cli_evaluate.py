"""bsmap evaluate by its entry point."""

import json
import shutil
from pathlib import Path

import pytest
from commands import assert_refused, bsmap, left_over, process


@pytest.fixture
def run(made: Path, tmp_path: Path) -> Path:
    for path in made.iterdir():
        shutil.copy(path, tmp_path)
    return tmp_path


def test_folder_of_a_run_gives_a_table_and_a_picture(run):
    done = process("evaluate", run, "--truth", run / "log.mcap")
    assert done.code == 0
    assert "trajectory RMS [m]" in done.out
    assert (run / "log.png").stat().st_size > 10_000
    assert f"{run / 'log.png'}: picture" in done.err


def test_common_name_json_and_another_picture(run):
    done = bsmap("evaluate", run / "log", "--truth", run / "log", "--json", "--picture", run / "map.svg")
    assert done.code == 0, done
    rows = json.loads(done.out)
    assert rows["trajectory RMS [m]"] < 0.005
    assert rows["cloud RMS [m]"] < 0.012
    assert rows["map bytes / cloud bytes"] > 0
    assert (run / "map.svg").read_text().lstrip().startswith("<?xml")


def test_what_it_refuses(run, tmp_path):
    assert_refused(bsmap("evaluate", run), 2, "Missing option '--truth'")
    assert_refused(bsmap("evaluate", run, "--truth", run / "other"), 66, "other.truth.tum: no such file")
    (run / "log.map.json").unlink()
    assert_refused(bsmap("evaluate", run / "log", "--truth", run / "log"), 66, "log.map.json: no such file")
    shutil.copy(run / "log.slam.mcap", run / "two.slam.mcap")
    assert_refused(bsmap("evaluate", run, "--truth", run / "log"), 66, "holds 2 runs")
    assert left_over(tmp_path) == []
