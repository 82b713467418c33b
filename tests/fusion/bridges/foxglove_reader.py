# SPDX-License-Identifier: BSD-3-Clause
"""Reads Foxglove's websocket and MCAP files with the schemas that they carry, without foxglove-sdk."""

import base64
import json
import re
import struct
import time
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pool, message_factory
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from mcap.reader import make_reader
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from tests.waiting import DEADLINE_S


class Decoder:
    """Decodes messages by the schema of their channel: a set of protobuf's file descriptors."""

    def __init__(self) -> None:
        self._kinds: dict[str, type] = {}

    def add(self, name: str, schema: bytes) -> None:
        if name not in self._kinds:
            pool = descriptor_pool.DescriptorPool()
            for file in FileDescriptorSet.FromString(schema).file:
                pool.Add(file)
            self._kinds[name] = message_factory.GetMessageClass(pool.FindMessageTypeByName(name))

    def decode(self, name: str, data: bytes) -> Any:
        return self._kinds[name].FromString(data)  # pyright: ignore[reportAttributeAccessIssue]


class FoxgloveClient:
    """A client of a live server; a context manager.

    Args:
        port: of the server.
        images: subscribe to images, too.
        only: subscribe only to topics that start so.
    """

    def __init__(self, port: int, images: bool = False, only: str = "") -> None:
        protocol = Subprotocol("foxglove.sdk.v1")
        self._socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], open_timeout=DEADLINE_S)
        self._images, self._only, self._decoder = images, only, Decoder()
        self._channels: dict[int, dict] = {}

    def __enter__(self) -> "FoxgloveClient":
        return self

    def __exit__(self, *exception: object) -> None:
        self._socket.close()

    def next(self, topic: str) -> tuple[str, int, Any]:
        """Topic, log time (ns) and content of the next message of a topic, or of topics that start with `topic`."""
        end = time.monotonic() + DEADLINE_S
        while time.monotonic() < end:
            received = self._socket.recv(timeout=DEADLINE_S)
            if isinstance(received, str):
                self._advertise(json.loads(received))
            elif received[0] == 1:
                number, t_ns = struct.unpack_from("<IQ", received, 1)
                channel = self._channels[number]
                if channel["topic"].startswith(topic):
                    return channel["topic"], t_ns, self._decoder.decode(channel["schemaName"], received[13:])
        raise TimeoutError(f"no message on {topic}")

    def _advertise(self, message: dict) -> None:
        # foxglove-sdk may advertise a channel that appears during a connection shortly before it accepts it.
        if message["op"] == "status" and (
            refused := re.search(r"(?i)unknown channel.*?(\d+)", message["message"])
        ):
            self._subscribe([self._channels[int(refused[1])]])
        if message["op"] != "advertise":
            return
        offered = [c for c in message["channels"] if c["topic"].startswith(self._only)]
        channels = [c for c in offered if self._images or not c["topic"].endswith("/image")]
        for channel in channels:
            self._channels[channel["id"]] = channel
            self._decoder.add(channel["schemaName"], base64.b64decode(channel["schema"]))
        self._subscribe(channels)

    def _subscribe(self, channels: list[dict]) -> None:
        subscriptions = [{"id": c["id"], "channelId": c["id"]} for c in channels]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": subscriptions}))


def read_mcap(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """(log time in ns, content) of the messages of a file, by topic."""
    decoder, found = Decoder(), {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            decoder.add(schema.name, schema.data)
            content = decoder.decode(schema.name, message.data)
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found
