"""bsmap run and the group: all stages, help, version, exit codes at the one boundary."""

import os
import subprocess
import sys
from pathlib import Path

import click
import pytest
from commands import BSMAP, assert_refused, bsmap, left_over, process

from bsmap_cli import __version__, cli
from bsmap_cli.errors import BadInputError, BsmapError, CannotWriteError, MissingInputError, MissingLibraryError

ENDINGS = (".slam.mcap", ".tum", ".cloud.ply", ".surfaces.json", ".map.json")
COMMANDS = ("run", "slam", "cloud", "fit", "merge", "export", "info", "import", "simulate", "evaluate")


def test_out_dir_gets_all_outputs_and_a_second_run_does_nothing(short_log, tmp_path):
    folder = tmp_path / "new" / "folder"
    done = process("run", short_log, "--out-dir", folder)
    assert done.code == 0
    assert done.out == ""
    assert "seconds: slam" in done.err
    assert sorted(path.name for path in folder.iterdir()) == sorted("log" + ending for ending in ENDINGS)
    assert list(short_log.parent.iterdir()) == [short_log]
    before = {path: path.read_bytes() for path in folder.iterdir()}
    done = bsmap("run", short_log, "--out-dir", folder)
    assert done.err.count("up to date") == 4
    # What is gone is made again, the same, so that what follows is up to date.
    (folder / "log.cloud.ply").unlink()
    done = bsmap("run", short_log, "--out-dir", folder)
    assert done.err.count("up to date") == 3
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert bsmap("run", short_log, "--out-dir", folder, "--force").err.count("up to date") == 0
    assert {path: path.read_bytes() for path in folder.iterdir()} == before
    assert left_over(folder) == []


def test_run_makes_what_the_stages_make_one_by_one(made, short_log, tmp_path):
    log = tmp_path / "log.mcap"
    log.write_bytes(short_log.read_bytes())
    for stage, ending in (
        ("slam", ".mcap"),
        ("cloud", ".slam.mcap"),
        ("fit", ".cloud.ply"),
        ("merge", ".surfaces.json"),
    ):
        assert bsmap(stage, tmp_path / f"log{ending}").code == 0
    for ending in ENDINGS:
        assert (tmp_path / f"log{ending}").read_bytes() == (made / f"log{ending}").read_bytes()


def test_artifacts_do_not_depend_on_where_they_lie_or_when(short_log, tmp_path, monkeypatch):
    """Same input, parameters and version: same bytes; a moved run stays up to date."""
    monkeypatch.chdir(tmp_path)
    Path("log.mcap").write_bytes(short_log.read_bytes())
    assert bsmap("slam", "log.mcap").code == 0
    (tmp_path / "moved").mkdir()
    for path in list(tmp_path.glob("log.*")):
        path.rename(tmp_path / "moved" / path.name)
    os.utime("moved/log.mcap", (1, 1))
    assert "up to date" in bsmap("slam", "moved/log.mcap").err


def test_what_run_refuses(short_log, tmp_path):
    assert_refused(bsmap("run", tmp_path / "gone.mcap", "--out-dir", tmp_path / "out"), 66, "no such file")
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").write_text("")
    assert_refused(bsmap("run", short_log, "--out-dir", tmp_path / "file"), 73, "no such folder can be made")
    assert_refused(bsmap("run", short_log, "--horizontal-topic", "/none", "--out-dir", tmp_path), 65, "/none")
    assert list(tmp_path.glob("*.slam.mcap")) == []


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help_with_units(command):
    done = bsmap(command, "--help")
    assert done.code == 0
    assert done.err == ""
    assert "Usage:" in done.out


def test_help_lists_the_commands_in_the_order_of_the_pipeline_and_the_exit_codes():
    out = bsmap("--help").out
    listed = [line.split()[0] for line in out.split("Commands:")[1].splitlines() if line.strip()]
    assert [word for word in listed if word in COMMANDS] == list(COMMANDS)
    for code in ("65", "66", "69", "73", "130"):
        assert code in out


def test_angles_are_shown_in_degrees():
    out = bsmap("slam", "--help").out
    assert "--breakpoint-angle" in out
    assert "[deg]" in out
    assert "10.0" in out


def test_version_and_unknown_command():
    assert bsmap("--version").out.strip().endswith(__version__)
    assert_refused(bsmap("fly"), 2, "No such command 'fly'")


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (BsmapError("no\n  way"), 1, "bsmap: error: no way"),
        (BadInputError("x"), 65, "bsmap: error: x"),
        (MissingInputError("x"), 66, "bsmap: error: x"),
        (MissingLibraryError("x"), 69, "bsmap: error: x"),
        (CannotWriteError("x"), 73, "bsmap: error: x"),
        (MemoryError(), 1, "bsmap: error: out of memory"),
        (KeyboardInterrupt(), 130, "bsmap: error: interrupted"),
        (click.Abort(), 130, "bsmap: error: interrupted"),
    ],
)
def test_every_error_ends_in_one_line_and_its_code(monkeypatch, error, code, message):
    def fail(**_):
        raise error

    monkeypatch.setattr(cli.cli.commands["info"], "callback", fail)
    done = bsmap("info", "x")
    assert (done.code, done.out) == (code, "")
    assert done.err.strip().startswith(message)  # after an interrupt the terminal's line is ended first
    assert done.err.strip().count("\n") == 0


def test_unforeseen_error_is_one_line_and_a_traceback_only_on_demand(monkeypatch, capsys):
    def fail(**_):
        raise ZeroDivisionError("over")

    monkeypatch.setattr(cli.cli.commands["info"], "callback", fail)
    monkeypatch.setattr(sys, "argv", ["bsmap", "info", "x"])
    monkeypatch.delenv("BSMAP_DEBUG", raising=False)
    assert cli._guarded() == 1
    assert "internal error, please report it: ZeroDivisionError: over" in capsys.readouterr().err
    monkeypatch.setenv("BSMAP_DEBUG", "1")
    with pytest.raises(ZeroDivisionError):
        cli._guarded()


def test_reader_of_the_output_that_goes_away_is_no_error(made):
    """bsmap info | head"""
    running = subprocess.Popen(
        [BSMAP, "info", made / "log.mcap"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    running.stdout.close()
    assert running.wait(30) == 0
    assert running.stderr.read() == ""
    running.stderr.close()


def test_names_too_long_or_odd_are_refused_like_any_missing_file(tmp_path):
    assert_refused(bsmap("slam", tmp_path / ("x" * 300 + ".mcap")), 66, "xxx")
    odd = tmp_path / "a b ü\n.mcap"
    assert_refused(bsmap("slam", odd), 66, "no such file")
