# SPDX-License-Identifier: BSD-3-Clause
"""Topics of ROS 2 in Zenoh, for nodes that run with RMW_IMPLEMENTATION=rmw_zenoh_cpp.

It puts the same bytes on the same keys as rmw_zenoh_cpp (its docs/design.md). The key of a topic consists of domain,
name, type and the type's hash; a liveliness token of the same shows it to `ros2 topic list`.
"""

import hashlib
import struct
import time
from functools import cached_property

import zenoh

from fusion.bridges.ros2_types import dds_name, type_hash

NODE = "roundel"
NO_HASH = "TypeHashNotSupported"  # in place of the hash in ROS 2 Humble, which has none
QOS = "::,10:,:,:,,"  # reliable, volatile, the last ten; everything else is rmw_zenoh's default


class ZenohNode:
    """A ROS 2 node in a Zenoh session: its publishers and their liveliness tokens.

    Args:
        session: an open Zenoh session.
        domain: ROS 2's domain.
        namespace: of the node, without slashes at its ends.
        humble: whether the nodes are of ROS 2 Humble, whose topics have no type hash.
    """

    def __init__(
        self, session: zenoh.Session, domain: int = 0, namespace: str = "", humble: bool = False
    ) -> None:
        self._session, self._domain, self._namespace, self._humble = session, domain, namespace, humble
        self._n_topics = 0
        self._token = session.liveliness().declare_token(self._entity(0, "NN"))

    def declare(self, name: str, kind: str) -> "ZenohTopic":
        """A publisher; see `Ros2Middleware.declare`."""
        self._n_topics += 1
        typed = f"{dds_name(kind)}/{NO_HASH if self._humble else type_hash(kind)}"
        entity = f"{self._entity(self._n_topics, 'MP')}/%{name.replace('/', '%')}/{typed}/{QOS}"
        return ZenohTopic(self._session, f"{self._domain}/{name}/{typed}", entity)

    def _entity(self, number: int, kind: str) -> str:
        """The common part of this node's tokens; slashes in names are replaced by %."""
        node = f"@ros2_lv/{self._domain}/{self._session.info.zid()}/0/{number}/{kind}"
        return f"{node}/%/%{self._namespace.replace('/', '%')}/{NODE}"


class ZenohTopic:
    """A publisher as in rmw_zenoh_cpp: the attachment of each message has its number, its time and the sender's id.

    Zenoh waits one or more milliseconds for further messages of a burst, here and in each router, until one of them is
    express: then it sends all that it has.
    """

    def __init__(self, session: zenoh.Session, key: str, entity: str) -> None:
        self._session, self._key = session, key
        self._publisher = session.declare_publisher(key)
        self._token = session.liveliness().declare_token(entity)
        self._gid = hashlib.blake2b(entity.encode(), digest_size=16).digest()
        self._count = 0

    @cached_property
    def _express(self) -> zenoh.Publisher:
        return self._session.declare_publisher(self._key, express=True)

    def put(self, data: bytes, is_last: bool) -> bool:
        """Send a message; if it `is_last` of a burst, without waiting for more. See `Ros2Topic.put`."""
        self._count += 1
        attachment = struct.pack("<qqB16s", self._count, time.time_ns(), len(self._gid), self._gid)
        (self._express if is_last else self._publisher).put(data, attachment=attachment)
        return True
