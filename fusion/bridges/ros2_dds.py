# SPDX-License-Identifier: BSD-3-Clause
"""Topics of ROS 2 in DDS, for nodes with rmw_cyclonedds_cpp, rmw_fastrtps_cpp or another implementation of DDS.

Names, types and qualities of service are those of ROS's design "ROS 2 on DDS": topic /tf is `rt/tf` in DDS, and the
hash of a type is in the writer's user data (REP 2016). The participant appears in `ros2 topic list`; it is no node, and
so is not in `ros2 node list`.
"""

import os
from typing import Any

from camera_node.foundation.extras import require
from fusion.bridges.ros2_types import dds_type, type_hash

DEADLINE_MS = (
    10  # offered; Crazyswarm2 asks for 100 poses a second, and gets none from a writer that offers less
)
BLOCKING_MS = 10  # that a slow reader may delay all others
ON_LOOPBACK = """<CycloneDDS><Domain>
<General><AllowMulticast>false</AllowMulticast>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>"""  # as rmw_cyclonedds_cpp does it


class DdsParticipant:
    """A participant of a DDS domain with its writers.

    Where it is found follows ROS's variables: with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, or ROS_LOCALHOST_ONLY=1,
    on this machine only, else by multicast; CYCLONEDDS_URI overrides both.

    Raises:
        ConfigError: cyclonedds is missing.
    """

    def __init__(self, domain: int = 0) -> None:
        parts = (_module(name) for name in ("core", "domain", "pub", "qos", "topic", "util"))
        self._core, entities, self._pub, self._qos, self._topic, self._util = parts
        config = ON_LOOPBACK if _is_local() and "CYCLONEDDS_URI" not in os.environ else ""
        self._domain = entities.Domain(domain, config) if config else None
        self._participant = entities.DomainParticipant(domain)

    def declare(self, name: str, kind: str) -> "DdsTopic":
        """A writer; see `Ros2Middleware.declare`."""
        policy, duration = self._qos.Policy, self._util.duration
        quality = self._qos.Qos(
            policy.Reliability.Reliable(duration(milliseconds=BLOCKING_MS)),
            policy.History.KeepLast(10),
            policy.Deadline(duration(milliseconds=DEADLINE_MS)),
            policy.Userdata(f"typehash={type_hash(kind)};".encode()),
        )
        topic = self._topic.Topic(self._participant, f"rt/{name}", dds_type(kind))
        return DdsTopic(self._pub.DataWriter(self._participant, topic, quality), self._core.DDSException)


class DdsTopic:
    """A writer of encoded messages.

    Args:
        writer: of cyclonedds.
        error: what `writer` raises.
    """

    def __init__(self, writer: Any, error: type[Exception]) -> None:
        self._writer, self._error = writer, error
        self._encoded = encoded_type(writer.data_type)

    def put(self, data: bytes, is_last: bool) -> bool:  # DDS sends each message at once
        """Send a message; whether no reader held it up."""
        try:
            self._writer.write(self._encoded(data))
        except self._error:
            return False
        return True


def encoded_type(message: Any) -> Any:
    """A class of messages like those of class `message`, made of their bytes."""

    class Encoded(message):
        def __init__(self, data: bytes) -> None:
            self._data = data

        def serialize(self, *_: object, **__: object) -> bytes:
            return self._data

    return Encoded


def _is_local() -> bool:
    """Whether ROS's variables restrict discovery to this machine."""
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    return reach.upper() == "LOCALHOST" or (not reach and os.environ.get("ROS_LOCALHOST_ONLY") == "1")


def _module(name: str) -> Any:
    return require(f"cyclonedds.{name}", "dds", "ROS 2 over DDS")
