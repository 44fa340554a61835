"""bsmap info by its entry point."""

import json

import pytest
from commands import assert_refused, bsmap, process


def test_log_is_described_with_the_part_of_each_topic(made):
    done = process("info", made / "log.mcap")
    assert done.code == 0
    assert done.err == ""
    described = json.loads(bsmap("info", "--json", made / "log.mcap").out)
    parts = {
        topic: (about["messages"], about["part"]) for topic, about in described["topics"].items() if "part" in about
    }
    assert parts["/laser_horizontal/scan"][0] == parts["/laser_vertical/scan"][0] == 26
    assert "horizontal" in parts["/laser_horizontal/scan"][1]
    assert "vertical" in parts["/laser_vertical/scan"][1]
    assert len(described["mounts"]) == 2
    assert described["time"]["seconds"] > 10
    for topic in described["topics"]:
        assert topic in done.out


@pytest.mark.parametrize(
    ("name", "stage"),
    [
        ("log.slam.mcap", "slam"),
        ("log.tum", "slam"),
        ("log.cloud.ply", "cloud"),
        ("log.surfaces.json", "fit"),
        ("log.map.json", "merge"),
    ],
)
def test_artifact_is_described_by_its_provenance(made, name, stage):
    described = json.loads(bsmap("info", "--json", made / name).out)
    assert described["stage"] == stage
    assert described["complete"] is True
    assert described["figures"]
    assert len(described["inputs"]) == 1
    text = bsmap("info", made / name).out
    assert f"stage: {stage}" in text


def test_cut_artifact_is_told_to_be_incomplete(made, tmp_path):
    for name in ("log.cloud.ply", "log.surfaces.json"):
        content = (made / name).read_bytes()
        (tmp_path / name).write_bytes(content[: 2 * len(content) // 3])
        assert json.loads(bsmap("info", "--json", tmp_path / name).out)["complete"] is False


def test_what_it_refuses(made, tmp_path):
    (tmp_path / "notes.txt").write_text("nothing of ours\n")
    assert_refused(bsmap("info", tmp_path / "notes.txt"), 65, "neither an MCAP log nor a file made by bsmap")
    assert_refused(bsmap("info", tmp_path / "gone.mcap"), 66, "no such file")
    assert_refused(bsmap("info"), 2, "Missing argument")


def test_topic_that_is_not_there_does_not_keep_the_others_from_being_shown(made, caplog):
    done = bsmap("info", made / "log.mcap", "--odometry-topic", "/none")
    assert done.code == 0
    assert "/laser_vertical/scan" in done.out
    assert "no odometry topic /none" in caplog.text
