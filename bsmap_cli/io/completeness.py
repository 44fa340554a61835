"""Is a file whole? A cheap look at what each format says of its own end, so that a cut artifact is made again."""

import gzip
import json
import os
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

MCAP_MAGIC = b"\x89MCAP0\r\n"
_PLY_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


def is_complete(path: Path | str) -> bool:
    """Whether a file ends where its format says; True for formats that do not say, False for no or an empty file."""
    path = Path(path)
    try:
        with open(path, "rb") as file:
            head = file.read(65536)
            file.seek(max(0, os.fstat(file.fileno()).st_size - 64))
            tail = file.read()
        return bool(head) and _check_for(path, head)(path, head, tail)
    except OSError:
        return False


def _check_for(path: Path, head: bytes) -> Callable[[Path, bytes, bytes], bool]:
    checks: dict[bytes, Callable[[Path, bytes, bytes], bool]] = {
        MCAP_MAGIC: lambda path, head, tail: tail.endswith(MCAP_MAGIC),
        b"ply": _is_whole_ply,
        b"\x1f\x8b": _is_whole_gzip,
        b"glTF": lambda path, head, tail: int.from_bytes(head[8:12], "little") == path.stat().st_size,
        b"{": lambda path, head, tail: _is_whole_json(path.read_bytes()),
    }
    if path.suffix.lower() == ".stl" and not head.startswith(b"solid"):
        return _is_whole_stl
    if path.suffix.lower() == ".tum":
        return _is_whole_tum
    found = [check for magic, check in checks.items() if head.startswith(magic)]
    return found[0] if found else lambda path, head, tail: tail.endswith(b"\n")


def _is_whole_stl(path: Path, head: bytes, tail: bytes) -> bool:
    return len(head) >= 84 and path.stat().st_size == 84 + 50 * struct.unpack_from("<I", head, 80)[0]


def _is_whole_tum(path: Path, head: bytes, tail: bytes) -> bool:
    count = re.search(rb"^# poses: (\d+)$", head, re.MULTILINE)
    lines = [line for line in path.read_bytes().split(b"\n")[:-1] if line and not line.startswith(b"#")]
    return tail.endswith(b"\n") and (count is None or len(lines) == int(count.group(1)))


def _is_whole_json(content: bytes) -> bool:
    try:
        json.loads(content)
    except ValueError:
        return False
    return True


def _is_whole_gzip(path: Path, head: bytes, tail: bytes) -> bool:
    try:
        content = gzip.decompress(path.read_bytes())
    except (EOFError, gzip.BadGzipFile, zlib.error):
        return False
    return not content.startswith(b"{") or _is_whole_json(content)


def ply_size(head: bytes) -> int | None:
    """Bytes of a whole binary PLY by its header; None where the header does not tell (lists, text, header cut)."""
    end = head.find(b"end_header\n")
    if end < 0 or b"\nformat ascii" in head[:end]:
        return None
    size, count = end + len(b"end_header\n"), 0
    for line in head[:end].decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["element"]:
            count = int(words[2])
        elif words[:1] == ["property"]:
            if words[1] not in _PLY_BYTES:
                return None
            size += count * _PLY_BYTES[words[1]]
    return size


def _is_whole_ply(path: Path, head: bytes, tail: bytes) -> bool:
    if b"end_header\n" not in head:
        return False
    size = ply_size(head)
    return size is None or path.stat().st_size == size
