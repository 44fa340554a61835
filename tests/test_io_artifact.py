"""Atomic output, fingerprints, provenance, completeness."""

import gzip
import math
import os
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from bsmap_cli.errors import BadInputError, CannotWriteError, MissingInputError
from bsmap_cli.io import artifact
from bsmap_cli.io.completeness import is_complete


@dataclass(frozen=True)
class Params:
    bound: float = 0.01
    range_max: float = math.inf


@pytest.fixture
def log(tmp_path: Path) -> Path:
    path = tmp_path / "log.mcap"
    path.write_bytes(b"content")
    return path


def _write(path: Path, error: type[BaseException] | None = None) -> None:
    with artifact.atomic_output(path) as temporary:
        temporary.write_text("x")
        if error:
            raise error


def test_atomic_output_replaces_and_leaves_nothing_beside(tmp_path: Path) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with artifact.atomic_output(target) as temporary:
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("error", [KeyboardInterrupt, RuntimeError])
def test_interrupted_write_keeps_the_old_file(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "a.txt"
    target.write_text("old")
    with pytest.raises(error):
        _write(target, error)
    assert target.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_output_into_a_missing_directory_is_refused_with_path_and_reason(tmp_path: Path) -> None:
    path = tmp_path / "none" / "a.txt"
    with pytest.raises(CannotWriteError, match=r"none/a\.txt: cannot be written: No such file or directory"):
        _write(path)
    assert not path.parent.exists()


@pytest.mark.parametrize("path", [Path("/dev/null"), Path("/tmp")])
def test_a_device_or_directory_is_never_replaced(path: Path) -> None:
    with pytest.raises(CannotWriteError, match="not a regular file"):
        _write(path)


def test_output_through_a_symbolic_link_writes_what_it_points_to(tmp_path: Path) -> None:
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    _write(tmp_path / "link.txt")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "real.txt").read_text() == "x"


def test_fingerprint_changes_with_stage_parameters_and_content_only(log: Path) -> None:
    parameters = artifact.plain_parameters(Params())
    first = artifact.fingerprint("fit", parameters, [log])
    os.utime(log, (0, 0))
    assert artifact.fingerprint("fit", dict(reversed(parameters.items())), [log]) == first
    assert len(first) == 56
    assert artifact.fingerprint("cloud", parameters, [log]) != first
    assert artifact.fingerprint("fit", parameters | {"bound": 0.02}, [log]) != first
    log.write_bytes(b"other")
    assert artifact.fingerprint("fit", parameters, [log]) != first


def test_fingerprint_depends_on_the_code_of_model_parameters_and_stage() -> None:
    package = Path(artifact.__file__).parent.parent
    names = {path.relative_to(package).as_posix() for path in artifact.code_of("merge")}
    assert {"model/surfaces.py", "params.py", "core/bspline.py", "io/artifact.py"} <= names
    assert {"merge/faces.py", "fit/heights.py"} <= names
    assert not any(name.startswith(("slam/", "cli/")) for name in names)


def test_fingerprint_of_a_missing_input_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(MissingInputError, match=r"no\.mcap: No such file"):
        artifact.fingerprint("slam", {}, [tmp_path / "no.mcap"])


def test_parameters_of_two_classes_must_not_collide() -> None:
    assert artifact.plain_parameters(Params()) == {"bound": 0.01, "range_max": "inf"}
    with pytest.raises(ValueError, match="bound"):
        artifact.plain_parameters(Params(), Params())


@pytest.mark.parametrize("template", ["# {}\nrest", 'comment {}\n"}}', "\0\x02{}\0\0"])
def test_provenance_is_found_wherever_it_stands(log: Path, tmp_path: Path, template: str) -> None:
    made = artifact.make_provenance("fit", {"bound": 0.01}, [log])
    made = replace(made, figures={"points": 3, "rms": 0.1})
    path = tmp_path / "a.txt"
    path.write_text(template.format(made.to_line()))
    assert artifact.read_provenance(path) == made
    assert artifact.read_fingerprint(path) == made.fingerprint
    path.with_suffix(".gz").write_bytes(gzip.compress(path.read_bytes()))
    assert artifact.read_fingerprint(path.with_suffix(".gz")) == made.fingerprint


def test_files_without_provenance(log: Path, tmp_path: Path) -> None:
    assert artifact.read_provenance(log) is None
    assert artifact.read_fingerprint(log) is None
    assert artifact.read_fingerprint(tmp_path / "none") is None
    log.write_text('# bsmap-provenance:{"stage":1')
    with pytest.raises(BadInputError, match="its provenance is damaged"):
        artifact.read_provenance(log)


PLY = b"ply\nformat binary_little_endian 1.0\nelement vertex 2\nproperty double x\nproperty int i\nend_header\n"
WHOLE = {
    "a.mcap": b"\x89MCAP0\r\n" + b"x" * 100 + b"\x89MCAP0\r\n",
    "a.ply": PLY + bytes(24),
    "a.json": b'{"a": {"b": 1}}',
    "a.json.gz": gzip.compress(b'{"a": 1}\n', mtime=0),
    "a.tum": b"# poses: 2\n1 2 3\n4 5 6\n",
    "a.stl": bytes(80) + struct.pack("<I", 1) + bytes(50),
    "a.glb": b"glTF\2\0\0\0" + struct.pack("<I", 20) + bytes(8),
    "a.obj": b"v 0 0 0\n",
}


@pytest.mark.parametrize("name", WHOLE)
def test_a_cut_file_is_not_complete(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(WHOLE[name])
    assert is_complete(path)
    for cut in (1, len(WHOLE[name]) // 2, len(WHOLE[name]) - 2):
        path.write_bytes(WHOLE[name][:-cut])
        assert not is_complete(path) or name == "a.obj", cut
    path.write_bytes(b"")
    assert not is_complete(path)
    assert not is_complete(tmp_path / "none")


def test_up_to_date_needs_fingerprint_and_end(tmp_path: Path, log: Path) -> None:
    made = artifact.make_provenance("slam", {}, [log])
    path = tmp_path / "a.txt"
    path.write_text(f"# {made.to_line()}\n1 2\n")
    assert artifact.is_up_to_date(path, made.fingerprint)
    assert not artifact.is_up_to_date(path, "0" * 56)
    path.write_text(f"# {made.to_line()}\n1 ")
    assert not artifact.is_up_to_date(path, made.fingerprint)
