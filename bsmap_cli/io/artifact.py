"""What all artifacts share: atomic writing, and the provenance that tells what an artifact was made from.

The provenance stands near the start of every artifact, uncompressed, as one line of JSON

    bsmap-provenance:{"fingerprint":"bsmap-fingerprint:<56 hex>","stage":...,"version":...,...}

in a PLY or OBJ comment, a comment line of a TUM file, a Metadata record of an MCAP file. A JSON or GLB file holds the
same object under the key `bsmap-provenance`. STL's header of 80 bytes holds the fingerprint alone, which is why it is
a SHA-224. It depends on no clock and no directory: same input, parameters and version, same bytes.
"""

import gzip
import hashlib
import json
import math
import os
import re
import stat
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from bsmap_cli import __version__
from bsmap_cli.errors import BadInputError, CannotWriteError, MissingInputError
from bsmap_cli.io.completeness import is_complete

HEAD_BYTES = 65536
_FINGERPRINT = re.compile(rb"bsmap-fingerprint:([0-9a-f]{40,64})")
_PROVENANCE = re.compile(r'bsmap-provenance"?\s*:\s*(?={)')
# Other programs' PLY readers take lines of 511 characters (VCG in MeshLab) or 1023 (RPly in Open3D, CloudCompare).
COMMENT_WIDTH = 400
_CONTINUED = "bsmap+:"
# A stage's code beside core/, io/, model/ and params.py, where it is not just the room of its name.
_ROOMS = {"merge": ("merge", "fit")}


@dataclass(frozen=True)
class Provenance:
    """Where an artifact comes from.

    stage, version : that made it.  parameters : the stage's, all of them, SI units.
    inputs : (file name, SHA-256 of the content) of each.  fingerprint : of all of these and the stage's code.
    figures : the stage's results in numbers, for `bsmap info`.
    """

    stage: str
    version: str
    parameters: dict[str, Any]
    inputs: tuple[tuple[str, str], ...]
    fingerprint: str
    figures: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """As plain JSON types; the fingerprint comes first, so that the head of a file is enough to find it."""
        plain = {"fingerprint": f"bsmap-fingerprint:{self.fingerprint}"} | asdict(self)
        return plain | {
            "fingerprint": f"bsmap-fingerprint:{self.fingerprint}",
            "inputs": [list(i) for i in self.inputs],
        }

    def to_line(self) -> str:
        """As one line of ASCII, for a comment or a metadata record."""
        return "bsmap-provenance:" + json.dumps(self.to_dict(), separators=(",", ":"))

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> "Provenance":
        """Inverse of `to_dict`; KeyError, TypeError or ValueError where something is missing or odd."""
        return cls(
            stage=str(plain["stage"]),
            version=str(plain["version"]),
            parameters=dict(plain["parameters"]),
            inputs=tuple((str(name), str(digest)) for name, digest in plain["inputs"]),
            fingerprint=str(plain["fingerprint"]).removeprefix("bsmap-fingerprint:"),
            figures=dict(plain["figures"]),
        )


def plain_json(value: Any) -> Any:
    """As JSON knows it: numpy's scalars become Python's, what is not finite becomes a word ("inf")."""
    if isinstance(value, Mapping):
        return {str(key): plain_json(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain_json(one) for one in value]
    scalar = value.item() if hasattr(value, "item") else value
    return str(scalar) if isinstance(scalar, float) and not math.isfinite(scalar) else scalar


def plain_parameters(*params: Any) -> dict[str, Any]:
    """One dict of the fields of parameter dataclasses, in their order, as JSON knows them.

    Raises ValueError where two classes share a field's name.
    """
    merged: dict[str, Any] = {}
    for one in params:
        fields = asdict(one)
        if twice := merged.keys() & fields.keys():
            raise ValueError(f"parameters given twice: {sorted(twice)}")
        merged |= fields
    return {key: plain_json(value) for key, value in merged.items()}


def make_provenance(stage: str, parameters: Mapping[str, Any], inputs: Sequence[Path | str]) -> Provenance:
    """Provenance, without figures, of what `stage` makes of `inputs` with `parameters` (plain JSON types)."""
    digests = tuple((Path(path).name, file_digest(path)) for path in inputs)
    content = [stage, __version__, code_digest(stage), dict(parameters), digests]
    canonical = json.dumps(content, sort_keys=True, separators=(",", ":"))
    fingerprint = hashlib.sha224(canonical.encode()).hexdigest()
    return Provenance(stage, __version__, dict(parameters), digests, fingerprint)


def fingerprint(stage: str, parameters: Mapping[str, Any], inputs: Sequence[Path | str]) -> str:
    """SHA-224 in hex of stage, version, the stage's code, parameters, and the inputs' names and contents."""
    return make_provenance(stage, parameters, inputs).fingerprint


def file_digest(path: Path | str) -> str:
    """SHA-256 of a file's content in hex; MissingInputError where it cannot be read."""
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error


@cache
def code_digest(stage: str) -> str:
    """SHA-256 of the sources that a stage's result depends on; the stage's room is the first word of its name."""
    package = Path(__file__).resolve().parent.parent
    digest = hashlib.sha256()
    for source in code_of(stage):
        digest.update(f"{source.relative_to(package).as_posix()}\n".encode())
        digest.update(source.read_bytes())
    return digest.hexdigest()


def code_of(stage: str) -> list[Path]:
    """Sources that a stage's result depends on."""
    stage, package = stage.split()[0], Path(__file__).resolve().parent.parent
    sources: list[Path] = []
    for room in ("core", "io", "model", "params", *_ROOMS.get(stage, (stage,))):
        sources += [package / f"{room}.py", *(package / room).rglob("*.py")]
    return sorted(source for source in sources if source.is_file())


@contextmanager
def atomic_output(path: Path | str) -> Iterator[Path]:
    """Path of a sibling file to write to, which takes the place of `path` when the block ends without an error.

    On any error, or an interrupt, the sibling is removed and `path` stays as it was.

    Raises
    ------
    CannotWriteError
        The file cannot be written, or `path` is a directory or a device.
    """
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".{os.getpid()}.part.{target.name}")  # keeps the ending, which tells the format
    try:
        if target.exists() and not stat.S_ISREG(target.stat().st_mode):
            raise CannotWriteError(f"{path}: is not a regular file; name another output")
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, target)
    except OSError as error:
        raise CannotWriteError(f"{path}: cannot be written: {error.strerror or error}") from error
    finally:
        with suppress(OSError):
            temporary.unlink(missing_ok=True)


def _flush_to_disk(path: Path) -> None:
    """Wait until the file's content is on disk, so that a crash after the move does not leave an empty file."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def read_head(path: Path | str, size: int = HEAD_BYTES) -> bytes:
    """First bytes of a file's content, unpacked where it is gzip; MissingInputError where it cannot be read."""
    try:
        with open(path, "rb") as file:
            if file.read(2) != b"\x1f\x8b":
                file.seek(0)
                return file.read(size)
        with gzip.open(path) as unpacked:
            return unpacked.read(size)
    except (EOFError, gzip.BadGzipFile, zlib.error):
        return b""
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error


def read_fingerprint(path: Path | str) -> str | None:
    """Fingerprint that an artifact carries; None where there is none or no such file."""
    try:
        found = _FINGERPRINT.search(read_head(path))
    except MissingInputError:
        return None
    return found.group(1).decode() if found else None


def read_provenance(path: Path | str) -> Provenance | None:
    """Provenance that an artifact carries; None where there is none.

    Raises
    ------
    MissingInputError
        The file cannot be read.
    BadInputError
        There is one, but it cannot be understood.
    """
    head = join_comments(read_head(path, 1 << 20).decode("utf-8", errors="replace"))
    found = _PROVENANCE.search(head)
    if found is None:
        return None
    try:
        return Provenance.from_dict(json.JSONDecoder().raw_decode(head, found.end())[0])
    except (KeyError, TypeError, ValueError) as error:
        raise BadInputError(f"{path}: its provenance is damaged ({error}); make the file again") from error


def split_comment(line: str) -> list[str]:
    """A long line as comments of at most COMMENT_WIDTH characters, for `join_comments` to join."""
    pieces = [line[i : i + COMMENT_WIDTH] for i in range(0, len(line), COMMENT_WIDTH)]
    return [pieces[0], *(_CONTINUED + piece for piece in pieces[1:])]


def join_comments(header: str) -> str:
    """Header of a PLY file with the comments of `split_comment` joined."""
    return header.replace(f"\ncomment {_CONTINUED}", "")


def is_up_to_date(path: Path | str, wanted: str) -> bool:
    """Whether `path` is a whole artifact with the fingerprint `wanted`."""
    return read_fingerprint(path) == wanted and is_complete(path)
