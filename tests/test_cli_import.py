"""bsmap import by its entry point."""

import gzip
from pathlib import Path

import numpy as np
import pytest
from commands import assert_refused, bsmap, left_over, process

from bsmap_cli.io.log import read_log
from bsmap_cli.io.slam_mcap import read_slam


def carmen(scans: int = 12) -> str:
    """A robot that drives 5 cm a scan along x towards a wall at 4 m, with walls at 2 m on both sides."""
    angles = np.radians(np.arange(-90.0, 90.0))
    lines = []
    for k in range(scans):
        x = 0.05 * k
        with np.errstate(divide="ignore"):
            ranges = np.minimum((4 - x) / np.maximum(np.cos(angles), 1e-9), 2 / np.abs(np.sin(angles)))
        pose, stamp = f"{x:.4f} 0 0", f"{10 + 0.2 * k:.3f} robot {0.2 * k:.3f}"
        lines.append(f"ODOM {pose} 0.25 0 0 {stamp}")
        lines.append(f"FLASER 180 {' '.join(f'{r:.3f}' for r in ranges)} {pose} {pose} {stamp}")
    return "\n".join(lines) + "\n"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "walk.clf"
    path.write_text(carmen())
    return path


def test_log_lies_beside_the_file_and_slam_reads_it(log):
    done = process("import", log)
    assert done.code == 0
    assert done.out == ""
    output = log.with_name("walk.mcap")
    assert f"{output}: messages 36" in done.err
    assert read_log(output).horizontal.ranges.shape == (12, 180)
    assert bsmap("slam", output).code == 0
    poses = read_slam(log.with_name("walk.slam.mcap")).trajectory.poses
    np.testing.assert_allclose(poses[-1], [0.55, 0, 0], atol=0.01)
    assert_refused(bsmap("cloud", log.with_name("walk.slam.mcap")), 65, "no vertical laser")


@pytest.mark.parametrize("name", ["walk.clf.gz", "walk.log.gz", "walk.log"])
def test_endings_are_taken_off(tmp_path, name):
    content = carmen().encode()
    (tmp_path / name).write_bytes(gzip.compress(content) if name.endswith("gz") else content)
    assert bsmap("import", tmp_path / name).code == 0
    assert (tmp_path / "walk.mcap").exists()


def test_it_is_made_once_and_again_when_the_file_changed(log, tmp_path):
    output = tmp_path / "walk.mcap"
    assert "up to date" not in bsmap("import", log).err
    first = output.read_bytes()
    assert "up to date" in bsmap("import", log).err
    assert "up to date" not in bsmap("import", log, "--force").err
    assert output.read_bytes() == first
    log.write_text(carmen(13))
    assert "messages 39" in bsmap("import", log).err
    assert bsmap("import", log, "-o", tmp_path / "other.mcap").code == 0
    assert (tmp_path / "other.mcap").exists()
    assert left_over(tmp_path) == []


def test_what_it_refuses(log, tmp_path):
    (tmp_path / "notes.log").write_text("nothing of ours\n")
    assert_refused(bsmap("import", tmp_path / "notes.log"), 65, "no laser scans", "is it a CARMEN log?")
    assert_refused(bsmap("import", tmp_path / "gone.log"), 66, "no such file")
    assert_refused(bsmap("import", log, "-o", log), 2, "is the input")
    assert_refused(bsmap("import", log, "-o", tmp_path / "no" / "x.mcap"), 73, "there is no folder")
    assert_refused(bsmap("import"), 2, "Missing argument")
