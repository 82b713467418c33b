# SPDX-License-Identifier: BSD-3-Clause
"""Completes recordings that were cut off or damaged: marks what can't be read, and writes a new index.

A damaged part becomes a private record, which every MCAP reader skips. Its bytes stay in the file.
"""

import zlib
from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, DataEnd, Footer, Header, McapRecord, Statistics

from calib.rig.recording_reader import (
    MAGIC,
    PROFILE,
    RECORD,
    SET_ASIDE,
    FilePart,
    ReadLimits,
    RecordingReader,
)
from camera_node.foundation.errors import ConfigError

HEADER = Header(profile=PROFILE, library="roundel")


@dataclass(frozen=True)
class Repair:
    """The result of a repair.

    Attributes:
        n_messages: messages in the recording.
        lost_bytes: bytes of the unfinished chunk that were removed.
        was_complete: there was nothing to repair.
        faults: what can't be read any more, by reason, but for the end.
    """

    n_messages: int
    lost_bytes: int
    was_complete: bool
    faults: Counter[str]


@dataclass
class _Content:
    """The complete records of a recording, which may be larger than the memory."""

    reader: RecordingReader
    is_sound: bool = True
    end: int = len(MAGIC)
    unmarked: list[FilePart] = field(default_factory=list)  # damaged parts, and chunks with another opcode
    chunks: list[ChunkIndex] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)  # messages by channel


def repair_recording(path: Path, max_size: int | None = None) -> Repair:
    """Complete a recording in place: mark its damaged parts, remove the unfinished chunk at its end, write the index.

    Args:
        path: an MCAP file with chunks, as `RecordingWriter` writes it.
        max_size: of the file in bytes, where the disk is full: the last chunks give way to the index.

    Raises:
        ConfigError: the file is missing, is not an MCAP recording, exceeds the limits or can't be written.
    """
    try:
        with path.open("rb+") as file:
            size = file.seek(0, 2)
            reader = RecordingReader(file, ReadLimits())
            content = _read_content(file, reader)
            if reader.n_too_large:
                raise ConfigError(
                    f"{path} is unchanged: it has {next(r for r in reader.faults() if r.startswith('chunks of'))}"
                )
            was_complete = content.is_sound
            lost_bytes = size - content.end if reader.is_cut_off else 0
            if not was_complete:
                _write_index(file, content, max_size)
            if any(part.records is None for part in content.unmarked):
                # A chunk of which only the length was wrong is readable now.
                reader = RecordingReader(file, reader.limits)
                content = _read_content(file, reader)
                if not content.is_sound:
                    _write_index(file, content, max_size)
    except OSError as error:
        raise ConfigError(
            f"{path} can't be repaired: {error.strerror}; check the path and the disk"
        ) from None
    faults = reader.faults()
    faults.pop("end: the recording was cut off", None)
    return Repair(content.counts.total(), lost_bytes, was_complete, faults)


def _read_content(file: IO[bytes], reader: RecordingReader) -> _Content:
    """Read all complete records behind the magic."""
    content = _Content(reader, is_sound=reader.is_complete)
    for part in reader.parts():
        if part.records is None:
            file.seek(part.start)
            if file.read(RECORD.size) != _mark(part):
                content.unmarked.append(part)
        else:
            times = []
            for message in reader.messages(part):
                content.counts[message.channel] += 1
                times = (
                    [min(message.t_ns, *times), max(message.t_ns, *times)] if times else [message.t_ns] * 2
                )
            if part.chunk is not None:
                content.chunks.append(_chunk_index(part, times))
                if part.opcode != Opcode.CHUNK:
                    content.unmarked.append(part._replace(records=b""))
        if part.opcode != Opcode.DATA_END:
            content.end = part.end
    content.is_sound &= not content.unmarked
    return content


def _mark(part: FilePart) -> bytes:
    """The start of the record that a part becomes: a chunk whose opcode was damaged, or one to skip."""
    opcode = SET_ASIDE if part.records is None else Opcode.CHUNK
    return RECORD.pack(opcode, part.end - part.start - RECORD.size)


def _chunk_index(part: FilePart, times: list[int]) -> ChunkIndex:
    compression, compressed_size, uncompressed_size = part.chunk or ("", 0, 0)
    return ChunkIndex(
        chunk_start_offset=part.start,
        chunk_length=part.end - part.start,
        message_start_time=times[0] if times else 0,
        message_end_time=times[1] if times else 0,
        message_index_offsets={},  # valid: readers then search the whole chunk
        message_index_length=0,
        compression=compression,
        compressed_size=compressed_size,
        uncompressed_size=uncompressed_size,
    )


def _write_index(file: IO[bytes], content: _Content, max_size: int | None) -> None:
    while content.chunks and max_size is not None and content.end + len(_index(content)) > max_size:
        content.end = content.chunks.pop().chunk_start_offset
        if (removed := content.reader.read_part(content.end)) is not None:
            content.counts -= Counter(message.channel for message in content.reader.messages(removed))
    for part in content.unmarked:
        if part.start < content.end:
            file.seek(part.start)
            file.write(_mark(part))
    file.seek(content.end)
    file.write(_index(content))
    file.truncate()
    file.flush()


def _index(content: _Content) -> bytes:
    """The bytes behind the last chunk: the end of the data, the summary and the footer."""
    reader = content.reader
    data_end = encode_records([] if reader.has_header else [HEADER], [DataEnd(data_section_crc=0)])
    definitions = [
        RECORD.pack(opcode, len(record)) + record
        for opcode, known in ((Opcode.SCHEMA, reader.schemas), (Opcode.CHANNEL, reader.channels))
        for record in known.values()
    ]
    summary = b"".join(definitions) + encode_records(
        [_statistics(content)] if content.chunks else [], content.chunks
    )
    start = content.end + len(data_end) if summary else 0
    # the checksum covers the summary and the footer up to the checksum itself
    unsigned = encode_records([Footer(summary_start=start, summary_offset_start=0, summary_crc=0)])
    crc = zlib.crc32(summary + unsigned[:-4])
    footer = encode_records([Footer(summary_start=start, summary_offset_start=0, summary_crc=crc)])
    return data_end + summary + footer + MAGIC


def _statistics(content: _Content) -> Statistics:
    times = [chunk for chunk in content.chunks if chunk.message_end_time]  # others only define channels
    starts, ends = [chunk.message_start_time for chunk in times], [chunk.message_end_time for chunk in times]
    if content.reader.statistics is not None:  # the recorder's: they include damaged parts at both ends
        starts.append(content.reader.statistics.start_ns)
        ends.append(content.reader.statistics.end_ns)
    return Statistics(
        message_count=content.counts.total(),
        schema_count=len(content.reader.schemas),
        channel_count=len(content.reader.channels),
        attachment_count=0,
        metadata_count=0,
        chunk_count=len(content.chunks),
        message_start_time=min(starts, default=0),
        message_end_time=max(ends, default=0),
        channel_message_counts=dict(content.counts),
    )


def encode_records(*groups: Iterable[McapRecord]) -> bytes:
    """The bytes of MCAP records, one after the other."""
    builder = RecordBuilder()
    for group in groups:
        for record in group:
            record.write(builder)
    return builder.end()
