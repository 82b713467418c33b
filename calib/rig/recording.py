# SPDX-License-Identifier: BSD-3-Clause
"""Recordings: messages in MCAP, as they came, one channel a key.

Messages are in MessagePack as on the wire, under their Zenoh keys; `log_time` is when one arrived, in the recorder's
clock. What an arena's recording holds beside detections is fusion's (`fusion.recordings.record`).
"""

import os
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO

from mcap.exceptions import McapError
from mcap.reader import NonSeekingReader
from mcap.writer import Writer

from calib.rig.history import keep
from camera_node.errors import ConfigError
from camera_node.protocol.messages import Detections, Keys, MessageError, decode, encode

MAGIC = 8  # bytes that every MCAP begins with
CHUNK = 1 << 16  # bytes, compressed together: what is lost of a recording that is cut off


class RecordingWriter:
    """Writes an arena's messages; a context manager. A recording that was cut off can be read to where it ends.

    Raises, at entry:
        ConfigError: the file can't be written.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.counts: Counter[str] = Counter()
        self._channels: dict[str, int] = {}

    def __enter__(self) -> "RecordingWriter":
        try:
            self._file: IO[bytes] = self.path.open("wb")
        except OSError as error:
            raise ConfigError(
                f"{self.path} can't be written: {error.strerror}; is its folder there?"
            ) from None
        self._writer = Writer(self._file, chunk_size=CHUNK)
        self._writer.start(profile="roundel", library="roundel")
        return self

    def __exit__(self, *exception: object) -> None:
        with self._file:
            self._writer.finish()

    def put(self, key: str, data: bytes, received_ns: int) -> None:
        """A message that arrived on a key."""
        if key not in self._channels:
            self._channels[key] = self._writer.register_channel(key, "msgpack", 0)
        self._writer.add_message(self._channels[key], received_ns, data, received_ns, self.counts[key])
        self.counts[key] += 1


def iterate(path: Path, faults: Counter[str] | None = None) -> Iterator[tuple[str, bytes, int]]:
    """Key, bytes and time of arrival (ns) of each message, in the order of arrival.

    Raises:
        ConfigError: the file is missing, or no MCAP.
    """
    try:
        with path.open("rb") as file:
            reader = NonSeekingReader(file)
            try:
                for _, channel, message in reader.iter_messages(log_time_order=False):
                    yield channel.topic, message.data, message.log_time
            except (McapError, EOFError, struct.error) as error:
                if faults is None or file.tell() <= MAGIC:
                    raise ConfigError(f"{path} is no MCAP recording: {error}") from None
                faults["end: the recording was cut off"] += 1
    except OSError as error:
        raise ConfigError(f"{path} can't be read: {error.strerror}; check the path") from None


def wave_beside(rig: Path) -> Path:
    """Where the wave is kept by which a rig was made."""
    return rig.with_name(f"{rig.stem}.wave.mcap")


def save_wave(path: Path, arena: str, messages: Iterable[Detections]) -> Path | None:
    """Write a wave's detections as `fusion record` would, as if each had arrived at once; never a part of them.

    Returns:
        the name under which the wave that was there before is kept, if one was.

    Raises:
        ConfigError: the folder can't be written to, or is full.
    """
    part, keys = path.with_name(f".{path.name}.part"), Keys(arena)
    try:
        with RecordingWriter(part) as writer:
            for message in messages:
                writer.put(keys.detections(message.camera), encode(message), message.t_ns)
        with part.open("rb+") as file:
            os.fsync(file.fileno())
        kept = keep(path)
        os.replace(part, path)
    except OSError as error:
        raise ConfigError(f"{path} can't be written: {error.strerror}") from None
    finally:
        part.unlink(missing_ok=True)
    return kept


def read_wave(path: Path) -> list[Detections]:
    """The detections of a recording; of one that was cut off, those that were written, and what is none is skipped.

    Raises:
        ConfigError: the file is missing, no recording, or holds no detections.
    """
    messages = []
    for key, data, _ in iterate(path, Counter()):
        if not key.endswith("/detections"):
            continue
        try:
            messages.append(decode(data, Detections))
        except MessageError:
            continue
    if not messages:
        raise ConfigError(f"{path} holds no detections; record with python -m fusion record {path}")
    return messages
