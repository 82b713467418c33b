# SPDX-License-Identifier: BSD-3-Clause
"""Reads and writes recordings: MCAP files of messages as they arrived, one channel per Zenoh key.

Messages are in MessagePack as on the wire. `log_time` is the time of arrival, in the recorder's clock. The other
messages of an arena's recording are defined by fusion (`fusion.recordings.arena_recording`).
"""

import contextlib
import io
import logging
import os
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

from mcap.records import Channel, Chunk
from mcap.writer import IndexType, Writer

from calib.rig.camera import Camera
from calib.rig.file_history import History
from calib.rig.recording_reader import PROFILE, ReadLimits, RecordingReader
from calib.rig.recording_repair import encode_records, repair_recording
from camera_node.foundation.config import new_path
from camera_node.foundation.errors import ConfigError, unwritable
from camera_node.protocol.messages import Detections, Keys, MessageError, decode, encode

LOG = logging.getLogger("calib")
MIN_CHUNK, MAX_CHUNK = 1 << 16, 1 << 20  # bytes compressed together: the most that a cut-off loses
MAX_LOST = 1 / 64  # of the file, between these: the writer remembers each chunk; and of repeated definitions


class RecordingWriter:
    """Writes the messages of an arena; a context manager. A recording that is cut off is readable up to its end.

    Where the disk is full, the file is completed within the space that it has, so that all readers can read it.

    Args:
        path: the MCAP file.
        overwrite: replace an existing file.
        appears_at: where the file is moved if it is whole: errors name that, and a full disk completes nothing.

    Raises, at entry:
        ConfigError: the file exists or can't be written.
    Raises, in `put` and at exit:
        ConfigError: the disk is full.
    """

    def __init__(self, path: Path, overwrite: bool = True, appears_at: Path | None = None) -> None:
        self.path, self._appears_at = path, appears_at
        self.counts: Counter[str] = Counter()
        self._mode = "wb" if overwrite else "xb"
        self._channels: dict[str, int] = {}
        self._definitions = b""  # of the channels, repeated behind chunks
        self._defined_at = 0  # in the file
        self._chunk, self._pending = MIN_CHUNK, 0  # bytes

    def __enter__(self) -> "RecordingWriter":
        try:
            self._file = cast(io.BufferedWriter, self.path.open(self._mode))
        except FileExistsError:
            raise ConfigError(f"{self.path} exists; give another name, or --force to replace it") from None
        except OSError as error:
            raise unwritable(self._appears_at or self.path, error) from None
        # An index of each channel in each chunk would take up to 0.1 kB of memory for each of them until the end.
        self._writer = Writer(self._file, chunk_size=MAX_CHUNK, index_types=IndexType.CHUNK)
        self._writer.start(profile=PROFILE, library="roundel")
        return self

    def __exit__(self, *exception: object) -> None:
        if self._file.closed:
            return
        try:
            self._writer.finish()
            self._file.flush()
            os.fsync(self._file.fileno())
            self._file.close()
        except OSError as error:
            raise self._close_full(error) from None

    @property
    def size(self) -> int:
        """Bytes in the file so far."""
        return self._file.tell()

    def put(self, key: str, data: bytes, received_ns: int) -> None:
        """Append a message that arrived on a key."""
        try:
            if key not in self._channels:
                encoding = "jpeg" if key.endswith("/snapshot") else "msgpack"
                number = self._channels[key] = self._writer.register_channel(key, encoding, 0)
                self._definitions += encode_records([Channel(number, key, encoding, {}, 0)])
            self._writer.add_message(self._channels[key], received_ns, data, received_ns, self.counts[key])
            self._pending += len(data)
            if self._pending >= self._chunk:
                self._end_chunk()
        except OSError as error:
            raise self._close_full(error) from None
        self.counts[key] += 1

    def _end_chunk(self) -> None:
        """Write the pending messages; the next chunk is larger as the file grows.

        The channels are defined again from time to time: without the index at the end, a damaged first chunk would
        cost all messages.
        """
        self._writer.flush()
        if len(self._definitions) <= MAX_LOST * (self.size - self._defined_at):
            content = self._definitions
            chunk = Chunk("", content, 0, 0, zlib.crc32(content), len(content))  # only chunks have check sums
            self._file.write(encode_records([chunk]))
            self._defined_at = self.size
        self._chunk, self._pending = min(MAX_CHUNK, max(MIN_CHUNK, int(MAX_LOST * self.size))), 0

    def _close_full(self, error: OSError) -> ConfigError:
        """Close a file that can't grow, with an index in place of its last chunks; the error to raise."""
        size = os.fstat(self._file.fileno()).st_size
        self._file.raw.close()  # without the buffered bytes, for which there is no space
        if self._appears_at is not None:
            return unwritable(self._appears_at, error)
        try:
            n = repair_recording(self.path, size).n_messages
            state = f"the recording is closed with {n} messages; free space on the disk"
        except ConfigError as fault:
            state = str(fault)
        return ConfigError(f"{self.path}: {error.strerror}: {state}")


def read_messages(
    path: Path,
    faults: Counter[str] | None = None,
    limits: ReadLimits | None = None,
    from_ns: int | None = None,
) -> Iterator[tuple[str, bytes, int]]:
    """Yield key, bytes and time of arrival (ns) of each message, in the order of arrival.

    Damaged parts are skipped, as are chunks and messages that state more than the limits.

    Args:
        path: the MCAP file.
        faults: is given what was skipped, at the end; without it, a recording that is not whole raises there.
        limits: see `ReadLimits`.
        from_ns: messages that arrived earlier are left out; the file is not read up to them where its index is whole.

    Raises:
        ConfigError: the file is missing, or not an MCAP file.
    """
    try:
        with path.open("rb") as file:
            reader = RecordingReader(file, limits or ReadLimits(), from_ns)
            try:
                for message in reader:
                    if from_ns is None or message.t_ns >= from_ns:
                        yield message.key, message.data, message.t_ns
            finally:
                if faults is not None:
                    faults |= reader.faults()  # the larger count: a file may be read several times
            if faults is None and (found := reader.faults()):
                reasons = "; ".join(f"{count} {reason}" for reason, count in found.items())
                raise ConfigError(f"{path} is not whole: {reasons}")
    except OSError as error:
        raise ConfigError(f"{path} can't be read: {error.strerror}; check the path") from None


def read_decoded(
    path: Path, kinds: Mapping[str, type], faults: Counter[str], names: Mapping[str, str] | None = None
) -> Iterator[tuple[int, Any]]:
    """Yield time of arrival (ns) and content of the messages of some kinds, in the order of arrival.

    Args:
        path: the MCAP file.
        kinds: of the messages, by the ends of their keys.
        faults: is given what was skipped: see `read_messages`; and messages that can't be decoded.
        names: of these in `faults`, by the ends of their keys; unless given, they are named by their keys.

    Raises:
        ConfigError: the file is missing, or not an MCAP file.
    """
    for key, data, received_ns in read_messages(path, faults):
        end = next((end for end in kinds if key.endswith(end)), None)
        if end is None:
            continue
        try:
            message = decode(data, kinds[end])
        except MessageError:
            faults[(names or {}).get(end, f"undecodable messages on {key}")] += 1
            continue
        yield received_ns, message


@contextlib.contextmanager
def new_recording(path: Path, overwrite: bool = True) -> Iterator[RecordingWriter]:
    """A writer of a recording that appears at `path` complete at the end, or not at all after an error.

    Raises:
        ConfigError: `path` exists and is not to be replaced, its folder can't be written to, or the disk is full.
    """
    if not overwrite and path.exists():
        raise ConfigError(f"{path} exists; give another name, or --force to replace it")
    with new_path(path) as part, RecordingWriter(part, appears_at=path) as writer:
        yield writer


def wand_recording_path(rig: Path) -> Path:
    """The path of the wand recording from which the rig file `rig` is calibrated."""
    return rig.with_name(f"{rig.stem}.wave.mcap")


def save_wand_recording(path: Path, arena: str, messages: Iterable[Detections]) -> Path | None:
    """Write detections atomically, in the format of `roundel record`, with capture times as times of arrival.

    Returns:
        the backup of the previous recording at `path`, if there was one.

    Raises:
        ConfigError: the folder can't be written to, or the disk is full.
    """
    keys = Keys(arena)
    with new_recording(path) as writer:
        for message in messages:
            writer.put(keys.detections(message.camera), encode(message), message.t_ns)
        backup = History(path).back_up()
    return backup


def read_detections(path: Path) -> list[Detections]:
    """Read the detections of a recording; what is skipped, as damaged parts and invalid messages, is logged.

    Raises:
        ConfigError: the file is missing, not an MCAP recording, or holds no detections.
    """
    faults, names = Counter[str](), {"/detections": "invalid detections"}
    messages = [found for _, found in read_decoded(path, {"/detections": Detections}, faults, names)]
    for reason, count in faults.items():
        LOG.warning("%s: skipped %d %s", path, count, reason)
    if not messages:
        raise ConfigError(f"{path} holds no detections; record with roundel record {path}")
    return messages


def as_they_arrived(
    messages: Iterable[Detections], cameras: Mapping[str, Camera]
) -> list[tuple[int, Detections]]:
    """Time of arrival (ns) and message in order, as if each arrived at its true capture time."""
    arrivals = [
        (cameras[m.camera].capture_ns(m.t_ns, m.sent_ns) if m.camera in cameras else m.t_ns, m)
        for m in messages
    ]
    return sorted(arrivals, key=lambda arrival: arrival[0])
