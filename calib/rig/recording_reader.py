# SPDX-License-Identifier: BSD-3-Clause
"""Reads MCAP files that may be cut off, damaged or hostile; the format is described at https://mcap.dev/spec.

Each chunk has a check sum, so damage costs the chunk that it is in. Where a record's own length is damaged, the next
chunk is found by its layout and its check sum. Our recordings number the messages of each key, so the numbers that are
missing tell how many messages were lost.
"""

import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import IO, NamedTuple

import zstandard
from mcap.opcode import Opcode

from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import MAX_BYTES

MAGIC = b"\x89MCAP0\r\n"
PROFILE = "roundel"  # of recordings whose messages are numbered without gaps on each key
PRIVATE = 0x80  # From here on, opcodes that MCAP leaves to applications; all readers skip such records.
SET_ASIDE = 0x86  # a damaged part that a repair found
MAX_KEYS_BYTES = 1 << 22  # of all keys of a file
MAX_T_NS = 1 << 63

RECORD = struct.Struct("<BQ")  # opcode, length of the content
CHUNK = struct.Struct("<QQQII")  # first and last time, size, check sum, length of the compression's name
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, time of arrival, time of publication
STATISTICS = struct.Struct(
    "<QHIIIIQQ"
)  # messages, schemas, channels, attachments, metadata, chunks, start, end
FOOTER = struct.Struct("<QQI")  # start of the summary, of its offsets, check sum
FOOTER_BYTES = RECORD.size + FOOTER.size + len(MAGIC)
COMPRESSIONS = b"", b"zstd", b"lz4"
MAX_CHUNK_HEADER = CHUNK.size + 4 + 8
# The start of a chunk of less than 4 GB, as it is searched behind damage.
CHUNK_PATTERN = re.compile(rb"(?s)\x06.{4}\0{4}.{28}(?:\0{4}|\x04\0{3}zstd|\x03\0{3}lz4)")
SEARCH_BYTES = 1 << 20
# Records between chunks; those of the summary are read by their check sum.
BETWEEN = {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE}
SKIPPED = {Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA}


@dataclass(frozen=True)
class ReadLimits:
    """What a file may state before it is believed; larger chunks and messages are skipped and counted.

    Attributes:
        chunk_bytes: of a chunk, compressed or not. The recorder ends a chunk at 1 MB and one message.
        message_bytes: of a message; other programs record larger ones than the network carries.
    """

    chunk_bytes: int = 8 * MAX_BYTES
    message_bytes: int = 4 * MAX_BYTES


class Message(NamedTuple):
    """A recorded message: its channel's number and key, its bytes and its time of arrival."""

    channel: int
    key: str
    data: bytes
    t_ns: int


class ChunkHeader(NamedTuple):
    """What a chunk states of itself: sizes in bytes, and the time of arrival of its last message."""

    compression: str
    compressed: int
    size: int
    check_sum: int
    end_ns: int


class FilePart(NamedTuple):
    """A part of the file: a chunk or another record, or bytes that can't be read.

    Attributes:
        start, end: in the file.
        opcode: of its record.
        records: the records of a chunk, or the record itself; None if it can't be read.
        chunk: compression, compressed size and size of a chunk.
    """

    start: int
    end: int
    opcode: int
    records: bytes | None = b""
    chunk: tuple[str, int, int] | None = None


@dataclass
class _Statistics:
    """Of a summary whose check sum is right."""

    n_messages: int
    start_ns: int
    end_ns: int


@dataclass
class RecordingReader:
    """Reads an MCAP file from its start to its end, once. Iterating yields its messages in the file's order.

    Args:
        file: it is read in portions; memory is bounded by the limits.
        limits: see `ReadLimits`.
        from_ns: chunks that end before this time are not read, where the index at the end defines their keys; what is
            missing is then unknown.

    Attributes:
        channels, schemas: the contents of their records, by number; `keys` are those of the channels.
        is_complete: the index at the end is there, and its check sum is right.
        is_cut_off: the data have no end.
        n_damaged: parts that can't be read.
        n_too_large: chunks and messages beyond the limits.
        missing_s: the time between the messages before and behind all damaged parts.

    Raises:
        ConfigError: the file is no MCAP file.
    """

    file: IO[bytes]
    limits: ReadLimits = field(default_factory=ReadLimits)
    from_ns: int | None = None
    channels: dict[int, bytes] = field(default_factory=dict)
    schemas: dict[int, bytes] = field(default_factory=dict)
    keys: dict[int, str] = field(default_factory=dict)
    is_complete: bool = False
    is_cut_off: bool = False
    n_damaged: int = 0
    n_too_large: int = 0
    n_invalid: int = 0
    n_messages: int = 0
    missing_s: float = 0.0

    def __post_init__(self) -> None:
        self.file.seek(0)
        if self.file.read(len(MAGIC)) != MAGIC:
            raise ConfigError(
                f"{self.file.name} is not an MCAP recording; give a file that roundel record wrote"
            )
        self._size = self._end = self.file.seek(0, 2)
        self.has_header = False
        self.statistics: _Statistics | None = None
        self._profile = ""
        self._key_bytes = self._n_gaps = 0
        self._next: Counter[int] = Counter()  # number of the next message, by channel
        self._last_ns: int | None = None
        self._first_ns: int | None = None
        self._is_behind_damage = False
        self._read_summary()

    def __iter__(self) -> Iterator[Message]:
        for part in self.parts():
            yield from self.messages(part)

    @property
    def n_missing(self) -> int:
        """Messages that the recorder wrote and this reader did not find, as far as that is known."""
        if self.from_ns is not None:
            return 0
        stated = self.statistics.n_messages - self.n_messages if self.statistics else 0
        return max(stated, self._n_gaps)

    def faults(self) -> Counter[str]:
        """What was skipped, counted by reason."""
        faults: Counter[str] = Counter()
        if self.is_cut_off:
            faults["end: the recording was cut off"] = 1
        if self.n_damaged:
            parts = "1 damaged part" if self.n_damaged == 1 else f"{self.n_damaged} damaged parts"
            where = f"{parts} of the recording, {self.missing_s:.2f} s in all"
            faults[f"messages in {where}" if self.n_missing else where] = self.n_missing or self.n_damaged
        elif self.n_missing and not self.n_too_large:
            faults["messages that the recorder counted and the recording does not hold"] = self.n_missing
        if self.n_too_large:
            mb = self.limits.chunk_bytes / 1e6
            faults[
                f"chunks of more than {mb:.0f} MB, or messages of more than {self.limits.message_bytes / 1e6:.0f} MB; "
                "if the file can be trusted, rewrite it with roundel repair --out --max-chunk-mb"
            ] = self.n_too_large
        if self.n_invalid:
            faults["invalid records in the recording"] = self.n_invalid
        return faults

    def parts(self) -> Iterator[FilePart]:
        """Yield chunks and other records; damaged ones that follow each other are one part."""
        position, damaged_from, has_end = len(MAGIC), None, False
        while position is not None and position < self._end and not has_end:
            part = self.read_part(position)
            if part is None or part.records is None:
                damaged_from = position if damaged_from is None else damaged_from
                position = self._find_chunk(damaged_from + 1) if part is None else part.end
                continue
            if damaged_from is not None:
                yield self._damage(damaged_from, position)
                damaged_from = None
            if part.chunk is not None and self._is_too_large(part.chunk):
                self.n_too_large += 1
                self._is_behind_damage = True
            yield part
            position, has_end = part.end, part.opcode == Opcode.DATA_END
        self.is_cut_off = not self.is_complete and not has_end
        if damaged_from is not None and self.is_complete:
            yield self._damage(damaged_from, self._end)
        if self.statistics is not None and self._is_behind_damage:
            self._add_gap(self.statistics.end_ns)

    def messages(self, part: FilePart) -> Iterator[Message]:
        """Yield the messages of a part, and remember its channels."""
        at, records = 0, part.records or b""
        while at + RECORD.size <= len(records):
            opcode, length = RECORD.unpack_from(records, at)
            start, at = at + RECORD.size, at + RECORD.size + length
            if at > len(records):
                break
            if opcode == Opcode.MESSAGE:
                message = self._message(records, start, at)
                if message is not None:
                    yield message
            elif opcode in (Opcode.CHANNEL, Opcode.SCHEMA):
                self._add_definition(opcode, records[start:at])
        self.n_invalid += at != len(records)

    def _message(self, records: bytes, start: int, end: int) -> Message | None:
        if end - start < MESSAGE.size:
            self.n_invalid += 1
            return None
        channel, sequence, t_ns, _ = MESSAGE.unpack_from(records, start)
        key = self.keys.get(channel)
        if self._profile == PROFILE:
            self._n_gaps += max(0, sequence - self._next[channel])
            self._next[channel] = max(self._next[channel], sequence + 1)
        self.n_messages += 1
        if key is None or t_ns >= MAX_T_NS:
            self.n_invalid += 1
            return None
        if end - start - MESSAGE.size > self.limits.message_bytes:
            self.n_too_large += 1
            return None
        if self._is_behind_damage:
            self._add_gap(t_ns)
        self._last_ns = t_ns if self._last_ns is None else max(t_ns, self._last_ns)
        return Message(channel, key, records[start + MESSAGE.size : end], t_ns)

    def _add_gap(self, t_ns: int) -> None:
        """Add the time from the last message before a damaged part to the first one behind it."""
        before = self._last_ns
        if before is None and self.statistics is not None:
            before = self.statistics.start_ns
        self.missing_s += max(0, t_ns - (t_ns if before is None else before)) / 1e9
        self._is_behind_damage = False

    def _add_definition(self, opcode: int, content: bytes) -> None:
        known = self.channels if opcode == Opcode.CHANNEL else self.schemas
        number = int.from_bytes(content[:2], "little")
        if known.get(number) == content:
            return
        self._key_bytes += len(content)
        if self._key_bytes > MAX_KEYS_BYTES:
            self.n_invalid += 1
            return
        if opcode == Opcode.CHANNEL:
            length = int.from_bytes(content[4:8], "little")
            try:
                self.keys[number] = content[8 : 8 + length].decode()
            except UnicodeDecodeError:
                self.n_invalid += 1
                return
        known[number] = content

    def _damage(self, start: int, end: int) -> FilePart:
        self.n_damaged += 1
        self._is_behind_damage = True
        return FilePart(start, end, SET_ASIDE, None)

    def read_part(self, start: int) -> FilePart | None:
        """The record at a position; None if none begins there."""
        self.file.seek(start)
        head = self.file.read(RECORD.size)
        if len(head) < RECORD.size:
            return None
        opcode, length = RECORD.unpack(head)
        end = start + RECORD.size + length
        if end > self._end:
            return None
        if (header := self._chunk_header(length)) is not None:
            return self._read_chunk(start, end, opcode, header)
        if opcode in SKIPPED or opcode >= PRIVATE or (opcode == Opcode.DATA_END and length == 4):
            return FilePart(start, end, opcode, None if opcode == SET_ASIDE else b"")
        is_misplaced = start == len(MAGIC) and opcode != Opcode.HEADER  # which each file begins with
        if opcode not in BETWEEN or length > self.limits.chunk_bytes or is_misplaced:
            return None
        content = self.file.read(length)
        if opcode != Opcode.HEADER:
            return FilePart(start, end, opcode, head + content)
        return FilePart(start, end, opcode) if self._read_header(content) else None

    def _read_header(self, content: bytes) -> bool:
        """Whether a header's two texts fill it."""
        size = int.from_bytes(content[:4], "little")
        if len(content) != 8 + size + int.from_bytes(content[4 + size : 8 + size], "little"):
            return False
        try:
            self._profile, _ = content[4 : 4 + size].decode(), content[8 + size :].decode()
        except UnicodeDecodeError:
            return False
        self.has_header = True
        return True

    def _chunk_header(self, length: int) -> ChunkHeader | None:
        """The header of the chunk whose content begins here; else None.

        The opcode has no part in it: the sizes agree by chance in no other record.
        """
        content = self.file.read(min(length, MAX_CHUNK_HEADER))
        self.file.seek(-len(content), 1)
        if length < CHUNK.size + 8 or len(content) < CHUNK.size + 8:
            return None
        _, end_ns, size, check_sum, n = CHUNK.unpack_from(content)
        compression = content[CHUNK.size : CHUNK.size + n]
        if n > 4 or compression not in COMPRESSIONS or len(content) < CHUNK.size + n + 8:
            return None
        compressed = int.from_bytes(content[CHUNK.size + n : CHUNK.size + n + 8], "little")
        if CHUNK.size + n + 8 + compressed != length:
            return None
        return ChunkHeader(compression.decode(), compressed, size, check_sum, end_ns)

    def _read_chunk(self, start: int, end: int, opcode: int, header: ChunkHeader) -> FilePart:
        chunk = compression, compressed, size = header[:3]
        is_earlier = self.from_ns is not None and self.is_complete and header.end_ns < self.from_ns
        if is_earlier or compressed > self.limits.chunk_bytes:
            return FilePart(start, end, opcode, b"", chunk)
        self.file.seek(end - compressed)
        data = self.file.read(compressed)
        try:
            if compression == "zstd" and zstandard.frame_content_size(data) not in (size, -1):
                return FilePart(start, end, opcode, None, chunk)  # the frame contradicts its chunk
            if self._is_too_large(chunk):
                return FilePart(start, end, opcode, b"", chunk)
            records = _decompress(data, compression, size)
        except Exception:  # whatever the decompressor raises: the chunk is damaged
            records = None
        if records is not None and (len(records) != size or header.check_sum not in (0, zlib.crc32(records))):
            records = None
        return FilePart(start, end, opcode, records, chunk)

    def _is_too_large(self, chunk: tuple[str, int, int]) -> bool:
        return max(chunk[1:]) > self.limits.chunk_bytes

    def _find_chunk(self, start: int) -> int | None:
        """The position of the next readable chunk from a position on."""
        while start < self._end:
            self.file.seek(start)
            block = self.file.read(min(SEARCH_BYTES, self._end - start))
            for found in CHUNK_PATTERN.finditer(block):
                part = self.read_part(start + found.start())
                if part is not None and part.chunk is not None and part.records:
                    return part.start
            start += max(1, len(block) - RECORD.size - MAX_CHUNK_HEADER)
            if len(block) < SEARCH_BYTES:
                break
        return None

    def _read_summary(self) -> None:
        """Read the index at the end of the file, if it is there and its check sum is right."""
        if self._size < len(MAGIC) + FOOTER_BYTES:
            return
        self.file.seek(self._size - FOOTER_BYTES)
        tail = self.file.read(FOOTER_BYTES)
        start, _, check_sum = FOOTER.unpack_from(tail, RECORD.size)
        begin = start or self._size - FOOTER_BYTES
        n_summary = self._size - FOOTER_BYTES - begin
        is_footer = RECORD.unpack_from(tail) == (Opcode.FOOTER, FOOTER.size) and tail.endswith(MAGIC)
        if not is_footer or begin < len(MAGIC) or not 0 <= n_summary <= self.limits.chunk_bytes:
            return
        self.file.seek(begin)
        summary = self.file.read(n_summary)
        if check_sum not in (0, zlib.crc32(summary + tail[: -len(MAGIC) - 4])):
            return
        self.is_complete, self._end = True, begin
        for _ in self.messages(FilePart(begin, self._size, Opcode.FOOTER, summary)):  # its channels
            pass
        self._read_statistics(summary)

    def _read_statistics(self, summary: bytes) -> None:
        at = 0
        while at + RECORD.size <= len(summary):
            opcode, length = RECORD.unpack_from(summary, at)
            if opcode == Opcode.STATISTICS and length >= STATISTICS.size:
                n_messages, *_, start_ns, end_ns = STATISTICS.unpack_from(summary, at + RECORD.size)
                self.statistics = _Statistics(n_messages, start_ns, end_ns)
            at += RECORD.size + length


def _decompress(data: bytes, compression: str, size: int) -> bytes:
    """Decompress at most `size` bytes: what a frame states about itself is not believed."""
    if compression == "zstd":
        return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)
    if compression == "lz4":
        import lz4.frame  # no recording of ours

        return lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size)
    return data
