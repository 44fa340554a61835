"""bsmap slam by its entry point."""

import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from commands import BSMAP, assert_caches, assert_refused, assert_usual_refusals, bsmap, left_over, process
from scenes import first_scans, simulated

from bsmap_cli.io.artifact import read_provenance
from bsmap_cli.io.log import write_scans
from bsmap_cli.io.slam_mcap import read_slam
from bsmap_cli.io.tum import read_tum


@pytest.fixture
def log(short_log: Path, tmp_path: Path) -> Path:
    path = tmp_path / "log.mcap"
    path.write_bytes(short_log.read_bytes())
    return path


def test_trajectory_and_map_lie_beside_the_log(log):
    done = process("slam", log)
    assert done.code == 0
    assert done.out == ""
    slam, tum = log.with_name("log.slam.mcap"), log.with_name("log.tum")
    assert f"{slam}, {tum}: scans 26" in done.err
    made = read_slam(slam)
    np.testing.assert_allclose(read_tum(tum).poses, made.trajectory.poses, atol=1e-8)
    provenance = read_provenance(slam)
    assert provenance.stage == "slam"
    assert provenance.figures["scans"] == 26
    assert read_provenance(tum).fingerprint == provenance.fingerprint


def test_it_is_made_once_and_again_when_something_changed(log):
    assert_caches(["slam", log], log.with_name("log.slam.mcap"), ["--min-length", "0.5"])


def test_second_output_that_is_gone_or_cut_is_made_again(log):
    tum = log.with_name("log.tum")
    bsmap("slam", log)
    whole = tum.read_bytes()
    for spoil in (tum.unlink, lambda: tum.write_bytes(whole[: len(whole) // 2])):
        spoil()
        assert "up to date" not in bsmap("slam", log).err
        assert tum.read_bytes() == whole
    assert "up to date" in bsmap("slam", log).err


def test_output_option_names_both_outputs(log, tmp_path):
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    assert bsmap("slam", log, "-o", folder / "one.slam.mcap").code == 0
    assert sorted(path.name for path in folder.iterdir()) == ["one.slam.mcap", "one.tum"]
    assert not log.with_name("log.slam.mcap").exists()
    assert_refused(bsmap("slam", log, "-o", folder / "two.tum"), 2, "is the name of two outputs")


def test_what_it_refuses(log, tmp_path):
    assert_usual_refusals("slam", log, tmp_path)


@pytest.mark.parametrize("ending", [".png", ".svg", ".pdf"])
def test_picture_is_the_same_when_made_at_once_and_from_the_artifact(log, ending):
    one, two = log.with_name("one" + ending), log.with_name("two" + ending)
    done = bsmap("slam", log, "--plot", one)
    assert f"{one}: picture" in done.err
    made = read_provenance(log.with_name("log.slam.mcap"))
    done = bsmap("slam", log, "--plot", two)
    assert "up to date" in done.err
    assert read_provenance(log.with_name("log.slam.mcap")) == made
    assert one.read_bytes() == two.read_bytes()
    magic = {".png": b"\x89PNG", ".svg": b"<?xml", ".pdf": b"%PDF"}[ending]
    assert one.read_bytes().startswith(magic)
    assert left_over(log.parent) == []


def test_several_pictures_at_once_and_with_the_papers_filter(log):
    pictures = [log.with_name("a.png"), log.with_name("b.svg")]
    assert bsmap("slam", log, "--method", "paper", "--plot", pictures[0], "--plot", pictures[1]).code == 0
    assert all(path.stat().st_size > 10_000 for path in pictures)


def test_picture_that_cannot_be_made_is_refused_before_the_work(log):
    slam = log.with_name("log.slam.mcap")
    assert_refused(bsmap("slam", log, "--plot", log.with_name("a.gif")), 2, "a.gif: pictures are made as .png")
    assert_refused(bsmap("slam", log, "--plot", log.parent / "none" / "a.png"), 73, "there is no folder")
    twice = log.with_name("a.png")
    assert_refused(bsmap("slam", log, "--plot", twice, "--plot", twice), 2, "is the name of two outputs")
    assert not slam.exists()


def test_loops_are_told_and_stand_in_the_artifact(log):
    done = bsmap("slam", log)
    assert "loops closed 0, loops refused 0" in done.err
    assert read_provenance(log.with_name("log.slam.mcap")).figures["loops_closed"] == 0
    assert "loops_refused: 0" in bsmap("info", log.with_name("log.slam.mcap")).out


def test_values_that_make_no_sense_are_refused_with_the_limit(log):
    assert_refused(bsmap("slam", log, "--min-length", "-1"), 2, "min_length: -1.0 is outside [0.01, None]")
    assert_refused(bsmap("slam", log, "--angle-sigma", "10"), 2, "10 is beyond the limit of 5.7")
    assert_refused(bsmap("slam", log, "--gate", "much"), 2, "'much' is not a valid float")
    assert_refused(bsmap("slam", log, "--range-sigma", "nan"), 2, "range_sigma")


def test_angles_are_degrees_and_their_default_is_exact(log):
    bsmap("slam", log)
    default = read_provenance(log.with_name("log.slam.mcap")).parameters
    assert default["breakpoint_angle"] == np.radians(10.0)
    assert "up to date" in bsmap("slam", log, "--breakpoint-angle", "10").err
    bsmap("slam", log, "--breakpoint-angle", "20")
    assert read_provenance(log.with_name("log.slam.mcap")).parameters["breakpoint_angle"] == np.radians(20.0)


def test_log_without_odometry_says_what_to_do(tmp_path):
    simulation, path = simulated("room"), tmp_path / "bare.mcap"
    scans = first_scans(simulation.log, 10)
    write_scans(path, scans.horizontal, scans.vertical, np.zeros(0, np.int64), np.zeros((0, 3)))
    assert_refused(bsmap("slam", path), 65, "--no-odometry")
    assert bsmap("slam", path, "--no-odometry").code == 0
    assert len(read_slam(tmp_path / "bare.slam.mcap").trajectory.time_ns) == 10


def test_log_without_vertical_laser_runs_and_one_without_returns_is_refused(tmp_path):
    simulation = simulated("room")
    scans = first_scans(simulation.log, 10).horizontal
    for name, horizontal in (("one", scans), ("blind", replace(scans, ranges=scans.ranges * np.float32(np.nan)))):
        write_scans(tmp_path / f"{name}.mcap", horizontal, None, simulation.odometry_time_ns, simulation.odometry_poses)
    assert bsmap("slam", tmp_path / "one.mcap").code == 0
    assert_refused(bsmap("slam", tmp_path / "blind.mcap"), 65, "has no scan with a valid range")


def test_quiet_says_nothing(log):
    assert bsmap("-q", "slam", log) == (0, "", "")


def test_failure_in_writing_leaves_the_old_artifact(log, monkeypatch):
    bsmap("slam", log)
    outputs = [log.with_name("log.slam.mcap"), log.with_name("log.tum")]
    before = [path.read_bytes() for path in outputs]

    def fail(path, *_):
        path.write_text("half of it")
        raise OSError(28, "No space left on device")

    for writer in ("slam_mcap.write_slam", "tum.write_tum"):
        with monkeypatch.context() as patch:
            patch.setattr(f"bsmap_cli.io.{writer}", fail)
            assert_refused(bsmap("slam", log, "--min-points", "8"), 73, "No space left on device")
        assert [path.read_bytes() for path in outputs] == before
        assert left_over(log.parent) == []


@pytest.mark.parametrize("writer", ["slam_mcap.write_slam", "tum.write_tum"])
def test_interrupt_while_writing_leaves_the_old_artifact(log, monkeypatch, writer):
    bsmap("slam", log)
    outputs = [log.with_name("log.slam.mcap"), log.with_name("log.tum")]
    before = [path.read_bytes() for path in outputs]

    def interrupt(path, *_):
        path.write_text("half of it")
        raise KeyboardInterrupt

    monkeypatch.setattr(f"bsmap_cli.io.{writer}", interrupt)
    assert_refused(bsmap("slam", log, "--min-points", "8"), 130, "interrupted")
    assert [path.read_bytes() for path in outputs] == before
    assert left_over(log.parent) == []


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_while_running_ends_it_cleanly(tmp_path, number, code):
    """A long log, and a signal in the middle of the work: the old artifacts stay, nothing unfinished is left."""
    simulation, path, times = simulated("corridor"), tmp_path / "long.mcap", 8
    scans, poses = simulation.log.horizontal, simulation.odometry_poses
    seconds = 100_000_000_000 * np.arange(times)[:, None]
    scans = replace(scans, time_ns=(scans.time_ns + seconds).ravel(), ranges=np.tile(scans.ranges, (times, 1)))
    odometry_ns = (simulation.odometry_time_ns + seconds).ravel()
    write_scans(path, scans, None, odometry_ns, np.tile(poses, (times, 1)))
    old = [tmp_path / "long.slam.mcap", tmp_path / "long.tum"]
    for file in old:
        file.write_text("old")
    running = subprocess.Popen([BSMAP, "slam", path], stderr=subprocess.PIPE, text=True)
    time.sleep(1.5)  # past the imports, far from the end
    running.send_signal(number)
    _, err = running.communicate(timeout=30)
    assert running.returncode == code, err
    assert "Traceback" not in err
    assert [file.read_text() for file in old] == ["old", "old"]
    assert left_over(tmp_path) == []


DROPS_THE_FIRST = """
import os, signal, sys, time, weakref
from bsmap_cli import cli
cli.AGAIN = 0.2
def work():
    thing = type("Thing", (), {})()
    # In the callback of a weak reference, as the import system has them, Python drops exceptions.
    gone = weakref.ref(thing, lambda _: (os.kill(os.getpid(), int(sys.argv[1])), time.sleep(0.05)))
    del thing
    time.sleep(10)
cli.cli.main = lambda **_: work()
cli.entry_point()
"""


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signal_that_python_drops_ends_the_run_all_the_same(number, code):
    command = [sys.executable, "-c", DROPS_THE_FIRST, str(int(number))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=8, check=False)
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
