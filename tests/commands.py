"""Calling the command line: inside this process for speed, as a process of its own where that is the point."""

import io
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import NamedTuple
from unittest import mock

from bsmap_cli import cli

BSMAP = Path(sys.executable).with_name("bsmap")


class Done(NamedTuple):
    """Exit code and what was printed."""

    code: int
    out: str
    err: str


def bsmap(*args: object) -> Done:
    """A command by the entry point's own boundary, in this process."""
    out, err = io.StringIO(), io.StringIO()
    argv = ["bsmap", *map(str, args)]
    with redirect_stdout(out), redirect_stderr(err), mock.patch.object(sys, "argv", argv):
        code = cli._guarded()
    return checked(Done(code, out.getvalue(), err.getvalue()))


def process(*args: object, timeout: float = 60, **options: object) -> Done:
    """A command as the user starts it."""
    command = [str(BSMAP), *map(str, args)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, **options)
    return checked(Done(done.returncode, done.stdout, done.stderr))


def checked(done: Done) -> Done:
    """The same; whatever goes wrong, nobody is shown a traceback or an internal error, and errors are one line."""
    assert "Traceback" not in done.err
    assert "internal error" not in done.err, done.err
    if done.code not in (0, 2):
        assert len([line for line in done.err.splitlines() if line.startswith("bsmap: error: ")]) == 1, done.err
    return done


def left_over(folder: Path) -> list[str]:
    """Unfinished files."""
    return [path.name for path in folder.rglob("*.part.*")]


def assert_refused(done: Done, code: int, *words: str) -> None:
    """It ended with this exit code, said all these words, and printed no result."""
    assert done.code == code, done
    assert all(word in done.err for word in words), done.err
    assert done.out == ""


def assert_caches(command: list, output: Path, option: list) -> None:
    """A second run says "up to date" and touches the output; a changed option recomputes; so does --force."""
    done = bsmap(*command)
    assert done.code == 0, done
    first = output.read_bytes()
    os.utime(output, (1, 1))
    done = bsmap(*command)
    assert done.code == 0
    assert "up to date" in done.err
    assert output.stat().st_mtime > 1
    assert output.read_bytes() == first
    done = bsmap(*command, *option)
    assert done.code == 0, done
    assert "up to date" not in done.err
    assert output.read_bytes() != first
    done = bsmap(*command)
    assert "up to date" not in done.err
    assert output.read_bytes() == first, "same input and parameters, same bytes"
    done = bsmap(*command, "--force")
    assert "up to date" not in done.err
    assert output.read_bytes() == first
    assert left_over(output.parent) == []


def assert_usual_refusals(command: str, source: Path, folder: Path) -> None:
    """What every stage with one input file refuses, and with which exit code; `source` is a good input."""
    wrong = folder / "wrong.mcap"
    wrong.write_bytes(b"not an artifact\n")
    cut = folder / ("cut" + source.name)
    cut.write_bytes(source.read_bytes()[: source.stat().st_size // 2])
    empty = folder / ("empty" + source.name)
    empty.write_bytes(b"")
    output = folder / "never.out"
    assert_refused(bsmap(command), 2, "Usage")
    assert_refused(bsmap(command, source, "--no-such-option"), 2, "o such option")
    assert_refused(bsmap(command, folder / "nowhere.mcap", "-o", output), 66, "nowhere.mcap: no such file")
    assert_refused(bsmap(command, folder, "-o", output), 66, "is a folder, a file is wanted")
    for bad in (wrong, cut, empty):
        assert_refused(bsmap(command, bad, "-o", output), 65, bad.name)
    assert_refused(bsmap(command, source, "-o", folder / "no" / "such" / "x"), 73, "there is no folder")
    assert_refused(bsmap(command, source, "-o", folder), 73, "is a folder")
    assert_refused(bsmap(command, source, "-o", source), 2, "is the input; name another output")
    assert not output.exists()
    assert left_over(folder) == []
