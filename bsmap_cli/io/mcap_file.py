"""MCAP files with ROS 2 messages: reading that saves what can be saved, writing that gives the same bytes each time.

The seeking reader of the mcap package finds nothing in a log that was cut, and neither of its readers checks CRCs
unless told to; so logs are read as a stream, chunk by chunk, and a damaged chunk is skipped.
"""

import logging
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from bsmap_cli import __version__
from bsmap_cli.errors import BadInputError, MissingInputError
from bsmap_cli.io import ros
from bsmap_cli.io.artifact import Provenance, atomic_output
from bsmap_cli.io.completeness import MCAP_MAGIC

logger = logging.getLogger("bsmap")

# What damage looks like to the mcap package; its CRCValidationError is a ValueError.
_DAMAGE = (McapError, ValueError, KeyError, IndexError, OverflowError, MemoryError, struct.error, zstandard.ZstdError)
_CHUNK_BYTES = 256 * 1024  # small, for damage costs a chunk
# For `ros2 bag play`: late subscribers get /tf_static too.
_LATCHED_QOS = "- {history: 1, depth: 1, reliability: 1, durability: 1}\n"


class McapMessage(NamedTuple):
    """A message as it stands in the file: `type_name` as in `nav_msgs/msg/Odometry`, times in ns, CDR in `data`."""

    topic: str
    type_name: str
    log_time: int
    data: bytes


def read_messages(path: Path | str, *, whole: bool = False) -> Iterator[McapMessage]:
    """Messages of an MCAP file in the order of the file.

    Of a damaged or cut file, the messages that can be had are given, and a warning with their number is logged; with
    `whole` it is refused, at the end.

    Raises
    ------
    MissingInputError
        There is no such file.
    BadInputError
        It is not an MCAP file, or not one message could be read, or it is damaged and should be whole.
    """
    path, count, damage = Path(path), 0, [""]
    _check_magic(path)
    channels: dict[int, tuple[str, str]] = {}
    schemas: dict[int, str] = {0: ""}
    for record in _sound_records(path, damage):
        if isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            channels[record.id] = record.topic, schemas.get(record.schema_id, "")
        elif isinstance(record, Message) and record.channel_id in channels:
            count += 1
            yield McapMessage(*channels[record.channel_id], record.log_time, record.data)
    if damage[0] and whole:
        raise BadInputError(f"{path}: {damage[0]}; make it again")
    if damage[0] and count:
        logger.warning("%s: %s; the %d messages that could be read are used", path, damage[0], count)
    elif not count:
        raise BadInputError(f"{path}: {damage[0] or 'holds no messages'}; nothing in it can be used")


def _check_magic(path: Path) -> None:
    try:
        with open(path, "rb") as file:
            head = file.read(16)
    except OSError as error:
        raise MissingInputError(f"{path}: {error.strerror or error}") from error
    if not head:
        raise BadInputError(f"{path}: is empty; record or copy it again")
    if head.startswith((b"#ROSBAG", b"SQLite format 3")):
        raise BadInputError(f"{path}: ROS 1 and SQLite bags are not read; convert it to MCAP (rosbags-convert)")
    if not head.startswith(MCAP_MAGIC):
        raise BadInputError(f"{path}: is not an MCAP file (CARMEN logs: `bsmap import` makes one)")


def _sound_records(path: Path, damage: list[str]) -> Iterator[Any]:
    """Records of a file with its sound chunks unpacked; what was wrong first is left in `damage`."""
    with open(path, "rb") as file:
        limit = max(path.stat().st_size, 1)
        records = StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=limit).records
        while True:
            try:
                record = next(records)
                parts = breakup_chunk(record, validate_crc=True) if isinstance(record, Chunk) else [record]
            except StopIteration:
                return
            except _DAMAGE as error:
                # After a broken chunk the stream goes on; after anything else it is at its end.
                what = "was cut" if isinstance(error, EndOfFile) else f"is damaged ({error})"
                damage[0] = damage[0] or what
            else:
                yield from parts


class RosWriter:
    """Writes ROS 2 messages to an open MCAP file; made by `ros_writer`."""

    def __init__(self, writer: Writer) -> None:
        self.mcap = writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def write(self, topic: str, message: Any, log_time: int) -> None:
        """Append a message of rosbags' type store."""
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._register(topic, message.__msgtype__)
        self.mcap.add_message(channel, log_time, ros.encode(message), log_time)

    def _register(self, topic: str, type_name: str) -> int:
        if type_name not in self._schemas:
            definition = ros.schema_text(type_name)
            self._schemas[type_name] = self.mcap.register_schema(type_name, "ros2msg", definition)
        metadata = {"offered_qos_profiles": _LATCHED_QOS if topic == "/tf_static" else ""}
        return self.mcap.register_channel(topic, "cdr", self._schemas[type_name], metadata)


@contextmanager
def ros_writer(path: Path | str, provenance: Provenance | None = None) -> Iterator[RosWriter]:
    """Writer of an MCAP file of ROS 2 messages: zstd, all CRCs, no clock; moved into place when the block ends.

    The provenance goes uncompressed to the very start of the file.
    """
    with atomic_output(path) as temporary, open(temporary, "wb") as file:
        zstd = CompressionType.ZSTD
        writer = Writer(file, _CHUNK_BYTES, compression=zstd, enable_crcs=True, enable_data_crcs=True)
        writer.start(profile="ros2", library=f"bsmap {__version__}")
        if provenance is not None:
            writer.add_metadata("bsmap", {"provenance": provenance.to_line()})
        yield RosWriter(writer)
        writer.finish()
