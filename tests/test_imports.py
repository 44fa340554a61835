"""The import rule, over the sources: imports point down, heavy packages stay out of the command line's start."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

import bsmap_cli

PACKAGE = Path(bsmap_cli.__file__).parent
BASE = {"errors", "model", "params", "track"}
STAGES = {"slam", "cloud", "fit", "merge", "export", "simulate", "evaluate", "picture"}
BELOW_STAGES = {"core", "open3d_loader"} | BASE
ALLOWED = {
    "errors": set(),
    "track": set(),
    "model": {"errors"},
    "params": {"errors"},
    "open3d_loader": {"errors"},
    "core": {"model", "errors"},
    "io": {"core", "model", "errors", "params"},  # params for LogParams: which topic plays which part
    **dict.fromkeys(STAGES, BELOW_STAGES),
    "merge": BELOW_STAGES | {"fit"},
    "cli": {"io"} | STAGES | BELOW_STAGES,
}
HEAVY = {"numpy", "scipy", "open3d", "trimesh", "mcap", "rosbags", "plyfile", "matplotlib"}
SOURCES = sorted(PACKAGE.rglob("*.py"))


def room_of(path):
    """First name below the package: io/ply.py -> io, model.py -> model; '' for the package itself."""
    return path.relative_to(PACKAGE).with_suffix("").parts[0].replace("__init__", "")


def imported(tree):
    """Full names of all modules that a syntax tree imports."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"line {node.lineno}: relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imported_at_once(tree):
    """As `imported`, without what stands inside functions."""
    outside = [node for node in ast.iter_child_nodes(tree) if not isinstance(node, ast.FunctionDef)]
    yield from imported(ast.Module(outside, []))


def rooms(names):
    """Rooms of this package among full names of modules; `from bsmap_cli import __version__` is of none."""
    found = {name.split(".")[1] for name in names if name.startswith("bsmap_cli.")}
    return {room for room in found if not room.startswith("_")}


def parse(path):
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_point_down(path):
    room = room_of(path)
    used = rooms(imported(parse(path)))
    assert used <= ALLOWED.get(room, set()) | {room}, f"{room} may import {sorted(ALLOWED.get(room, set()))} only"


def test_import_rule_knows_every_room():
    assert {room_of(path) for path in SOURCES} - {""} <= set(ALLOWED)


def test_open3d_is_imported_in_one_place():
    users = {path.name for path in SOURCES if any(n.split(".")[0] == "open3d" for n in imported(parse(path)))}
    assert users <= {"open3d_loader.py"}


@pytest.mark.parametrize(
    "path",
    [path for path in SOURCES if room_of(path) in {"cli", "errors", "params", "track", ""}],
    ids=lambda path: str(path.relative_to(PACKAGE)),
)
def test_command_line_starts_without_heavy_imports(path):
    at_once = set(imported_at_once(parse(path)))
    assert not {name.split(".")[0] for name in at_once} & HEAVY
    assert not rooms(at_once) & (STAGES | {"core", "io", "model"})


def test_rule_finds_a_forbidden_import():
    tree = ast.parse("def f():\n    from bsmap_cli.io import artifact\nimport bsmap_cli.cli.run\nimport numpy as np\n")
    assert rooms(imported(tree)) == {"io", "cli"}
    assert set(imported_at_once(tree)) == {"bsmap_cli.cli.run", "numpy"}


def test_no_module_is_named_like_a_dependency_or_utils():
    names = {path.stem for path in SOURCES}
    assert not names & (HEAVY | {"click", "utils", "helpers", "common"})


def test_help_loads_no_heavy_package():
    code = (
        "import sys, contextlib\n"
        "from bsmap_cli.cli import cli\n"
        "with contextlib.suppress(SystemExit): cli.main(['--help'])\n"
        f"print(sorted(set(sys.modules) & {HEAVY!r}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_help_answers_at_once():
    """Least processor time of several runs of the real entry point, for other work may hold the processors."""
    bsmap = Path(sys.executable).with_name("bsmap")

    def seconds():
        before = os.times()
        subprocess.run([bsmap, "--help"], capture_output=True, check=True)
        after = os.times()
        return after.children_user + after.children_system - before.children_user - before.children_system

    assert min(seconds() for _ in range(5)) < 0.3
