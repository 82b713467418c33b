# SPDX-License-Identifier: BSD-3-Clause
"""Completes recordings that were cut off: writes the missing index behind the last complete chunk.

The format is described at https://mcap.dev/spec. A chunk holds messages and the channels that they need.
"""

import struct
import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from mcap.data_stream import RecordBuilder
from mcap.exceptions import McapError
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    Schema,
    Statistics,
)
from mcap.stream_reader import StreamReader, breakup_chunk

from camera_node.foundation.errors import ConfigError

MAGIC = b"\x89MCAP0\r\n"
HEADER = Header(profile="roundel", library="roundel")


@dataclass(frozen=True)
class Repair:
    """The result of a repair.

    Attributes:
        n_messages: messages in the recording.
        lost_bytes: bytes of the unfinished chunk that were removed.
        was_complete: there was nothing to repair.
    """

    n_messages: int
    lost_bytes: int
    was_complete: bool


@dataclass(frozen=True)
class _IndexedChunk:
    """A complete chunk: its entry in the index, the position behind it, and the messages of each channel."""

    index: ChunkIndex
    end: int
    counts: Counter[int]


@dataclass
class _Content:
    """The complete records of a recording."""

    has_header: bool = False
    has_footer: bool = False
    start: int = len(MAGIC)  # of the first chunk
    chunks: list[_IndexedChunk] = field(default_factory=list)
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)

    @property
    def end(self) -> int:
        return self.chunks[-1].end if self.chunks else self.start

    def counts(self) -> Counter[int]:
        """Messages by channel."""
        return sum((chunk.counts for chunk in self.chunks), Counter[int]())


def repair_recording(path: Path, max_size: int | None = None) -> Repair:
    """Complete a recording in place: remove the unfinished chunk at its end, and write the index.

    Args:
        path: an MCAP file with chunks, as `RecordingWriter` writes it.
        max_size: of the file in bytes, where the disk is full: the last chunks give way to the index.

    Raises:
        ConfigError: the file is missing, is not an MCAP recording or can't be written.
    """
    try:
        with path.open("rb+") as file:
            size = file.seek(0, 2)
            file.seek(0)
            if file.read(len(MAGIC)) != MAGIC:
                raise ConfigError(f"{path} is not an MCAP recording; give a file that roundel record wrote")
            content = _read_content(file)
            if not content.has_footer:
                _write_index(file, content, max_size)
    except OSError as error:
        raise ConfigError(
            f"{path} can't be repaired: {error.strerror}; check the path and the disk"
        ) from None
    lost_bytes = 0 if content.has_footer else size - content.end
    return Repair(content.counts().total(), lost_bytes, content.has_footer)


def _read_content(file: IO[bytes]) -> _Content:
    """Read all complete records behind the magic. Damaged chunks are left out of the index."""
    content, start = _Content(), len(MAGIC)
    try:
        for record in StreamReader(file, skip_magic=True, emit_chunks=True).records:
            if isinstance(record, Header):
                content.has_header, content.start = True, file.tell()
            elif isinstance(record, Chunk):
                _add_chunk(content, record, start, file.tell())
            elif isinstance(record, Footer):
                content.has_footer = file.read(len(MAGIC)) == MAGIC
                break
            start = file.tell()
    except (McapError, ValueError, struct.error):  # the file ends inside a record
        pass
    return content


def _add_chunk(content: _Content, chunk: Chunk, start: int, end: int) -> None:
    try:
        records = breakup_chunk(chunk, validate_crc=True)
    except Exception:  # whatever the decompressor raises: the chunk is damaged
        return
    index = ChunkIndex(
        chunk_start_offset=start,
        chunk_length=end - start,
        message_start_time=chunk.message_start_time,
        message_end_time=chunk.message_end_time,
        message_index_offsets={},  # valid: readers then search the whole chunk
        message_index_length=0,
        compression=chunk.compression,
        compressed_size=len(chunk.data),
        uncompressed_size=chunk.uncompressed_size,
    )
    counts = Counter(record.channel_id for record in records if isinstance(record, Message))
    content.chunks.append(_IndexedChunk(index, end, counts))
    content.channels |= {record.id: record for record in records if isinstance(record, Channel)}
    content.schemas |= {record.id: record for record in records if isinstance(record, Schema)}


def _write_index(file: IO[bytes], content: _Content, max_size: int | None) -> None:
    while content.chunks and max_size is not None and content.end + len(_index(content)) > max_size:
        content.chunks.pop()
    file.seek(content.end)
    file.write(_index(content))
    file.truncate()
    file.flush()


def _index(content: _Content) -> bytes:
    """The bytes behind the last chunk: the end of the data, the summary and the footer."""
    data_end = _encode([] if content.has_header else [HEADER], [DataEnd(data_section_crc=0)])
    chunks = [chunk.index for chunk in content.chunks]
    summary = _encode(
        content.schemas.values(), content.channels.values(), [_statistics(content)] if chunks else [], chunks
    )
    start = content.end + len(data_end) if summary else 0
    # the checksum covers the summary and the footer up to the checksum itself
    unsigned = _encode([Footer(summary_start=start, summary_offset_start=0, summary_crc=0)])
    crc = zlib.crc32(summary + unsigned[:-4])
    footer = _encode([Footer(summary_start=start, summary_offset_start=0, summary_crc=crc)])
    return data_end + summary + footer + MAGIC


def _statistics(content: _Content) -> Statistics:
    counts = content.counts()
    return Statistics(
        message_count=counts.total(),
        schema_count=len(content.schemas),
        channel_count=len(content.channels),
        attachment_count=0,
        metadata_count=0,
        chunk_count=len(content.chunks),
        message_start_time=min(chunk.index.message_start_time for chunk in content.chunks),
        message_end_time=max(chunk.index.message_end_time for chunk in content.chunks),
        channel_message_counts=dict(counts),
    )


def _encode(*groups: Iterable[McapRecord]) -> bytes:
    builder = RecordBuilder()
    for group in groups:
        for record in group:
            record.write(builder)
    return builder.end()
