"""bsmap cloud by its entry point."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from commands import assert_caches, assert_refused, assert_usual_refusals, bsmap, process

from bsmap_cli.io.artifact import read_provenance
from bsmap_cli.io.cloud_ply import read_cloud
from bsmap_cli.io.slam_mcap import read_slam, write_slam


@pytest.fixture
def slam(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(made / "log.slam.mcap", tmp_path))


def test_cloud_lies_beside_the_slam_artifact(slam):
    done = process("cloud", slam)
    assert done.code == 0
    assert done.out == ""
    output = slam.with_name("log.cloud.ply")
    cloud = read_cloud(output)
    assert f"{output}: points {len(cloud.points)}, scans 26" in done.err
    assert read_provenance(output).stage == "cloud"


def test_it_is_made_once_and_again_when_something_changed(slam):
    assert_caches(["cloud", slam], slam.with_name("log.cloud.ply"), ["--range-max", "3"])


def test_output_option_and_range_limits(slam, tmp_path):
    assert bsmap("cloud", slam, "-o", tmp_path / "near.ply", "--range-max", "2.5", "--range-sigma", "0.02").code == 0
    near = read_cloud(tmp_path / "near.ply")
    whole = len(read_cloud(tmp_path / "near.ply").points)
    bsmap("cloud", slam)
    assert 0 < whole < len(read_cloud(slam.with_name("log.cloud.ply")).points)
    assert near.range_sigma == 0.02
    assert read_provenance(tmp_path / "near.ply").parameters["range_max"] == 2.5


def test_what_it_refuses(slam, tmp_path):
    assert_usual_refusals("cloud", slam, tmp_path)
    assert_refused(bsmap("cloud", slam, "--range-min", "100"), 65, "no return of the vertical laser")


def test_log_instead_of_slam_artifact_is_told_what_to_run(short_log, tmp_path):
    assert_refused(bsmap("cloud", short_log, "-o", tmp_path / "x.ply"), 65, "Run `bsmap slam` on it first")


def test_map_without_vertical_laser_says_so(slam, tmp_path):
    write_slam(tmp_path / "flat.slam.mcap", replace(read_slam(slam), vertical=None))
    assert_refused(bsmap("cloud", tmp_path / "flat.slam.mcap"), 65, "no vertical laser")
