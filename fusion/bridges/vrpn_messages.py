# SPDX-License-Identifier: BSD-3-Clause
"""The wire format of VRPN 7: cookies, descriptions of senders and types, and a tracker's reports.

A message is a header of six 32-bit integers (length of header and body, seconds, microseconds, sender, type, sequence
number) and a body, padded to a multiple of eight bytes; all numbers are big-endian. Each end numbers its senders and
types as it likes and describes the numbers by messages of negative type (vrpn_Connection.C, vrpn_Tracker.C of VRPN
7.35). Quaternions are x, y, z, w.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from fusion.protocol.pose_messages import RobotPose

COOKIE = b"vrpn: ver. 07.35  0".ljust(24, b"\0")  # the digit: the server is not to write a log
COOKIE_START = b"vrpn: ver. 07."
SENDER_DESCRIPTION, TYPE_DESCRIPTION, UDP_DESCRIPTION = -1, -2, -3
POSITION, VELOCITY, PONG, PING, TEXT = range(5)  # our numbers of types
TYPES = {
    POSITION: "vrpn_Tracker Pos_Quat",
    VELOCITY: "vrpn_Tracker Velocity",
    PONG: "vrpn_Base pong_message",
    PING: "vrpn_Base ping_message",
    TEXT: "vrpn_Base text_message",
}
NORMAL, WARNING = 0, 1  # severities of a text
VELOCITY_S = 0.01  # a turn is reported as the rotation in this time; above 300 rad/s it would be ambiguous
MAX_MESSAGE = 1 << 16  # bytes; clients send pings and names
HEADER = struct.Struct(">iiiiiI")
REPORT = struct.Struct(">ii7d")
VELOCITY_REPORT = struct.Struct(">ii8d")


@dataclass(frozen=True, slots=True)
class VrpnMessage:
    """A received message; `sender` and `type` are the other end's numbers."""

    sender: int
    type: int
    body: bytes


class FormatError(ValueError):
    """Bytes that are not VRPN's."""


def message(body: bytes, sender: int, type: int, t_ns: int = 0, sequence: int = 0) -> bytes:
    """Encode a message; `t_ns` is Unix time."""
    seconds, ns = divmod(t_ns, 1_000_000_000)
    header = HEADER.pack(HEADER.size + len(body), seconds, ns // 1000, sender, type, sequence & 0xFFFFFFFF)
    return header + body + bytes(-len(body) % 8)


def describe(kind: int, number: int, name: str) -> bytes:
    """Encode the name of one of our senders or types."""
    text = name.encode() + b"\0"
    return message(struct.pack(">i", len(text)) + text, number, kind)


def name_of(body: bytes) -> str:
    """The name in a description.

    Raises:
        FormatError: there is none.
    """
    if len(body) < 5 or struct.unpack_from(">i", body)[0] != len(body) - 4:
        raise FormatError("a description without a name")
    return body[4:].rstrip(b"\0").decode(errors="replace")


def reports(pose: RobotPose, sender: int, sequence: int) -> bytes:
    """Encode a pose's `Pos_Quat` and `Velocity`, of sensor 0, both with the pose's own time."""
    w, x, y, z = pose.quaternion_wxyz
    position = REPORT.pack(0, 0, *pose.position, x, y, z, w)
    velocity = VELOCITY_REPORT.pack(0, 0, *pose.velocity, *turn(pose.angular_velocity), VELOCITY_S)
    return message(position, sender, POSITION, pose.t_ns, sequence) + message(
        velocity, sender, VELOCITY, pose.t_ns, sequence + 1
    )


def text(words: str, sender: int, severity: int, t_ns: int, sequence: int) -> bytes:
    """Encode a text of a sender, which VRPN's clients print (vrpn_BaseClass.C): severity, level 0, words to a zero."""
    body = struct.pack(">II", severity, 0) + words.encode() + b"\0"
    return message(body, sender, TEXT, t_ns, sequence)


def turn(angular_velocity: tuple[float, float, float]) -> tuple[float, float, float, float]:
    """The quaternion x, y, z, w of the rotation in `VELOCITY_S` with an angular velocity (rad/s, world)."""
    x, y, z = angular_velocity
    speed = math.hypot(x, y, z)
    half = speed * VELOCITY_S / 2
    scale = math.sin(half) / speed if speed else 0.0
    return x * scale, y * scale, z * scale, math.cos(half)


def split(data: bytearray) -> Iterator[VrpnMessage]:
    """Remove the complete messages from the front of `data` and yield them.

    Raises:
        FormatError: a length is invalid.
    """
    while len(data) >= HEADER.size:
        length, _, _, sender, type, _ = HEADER.unpack_from(data)
        if not HEADER.size <= length <= MAX_MESSAGE:
            raise FormatError(f"a message of {length} bytes")
        padded = length + -length % 8
        if len(data) < padded:
            return
        body = bytes(data[HEADER.size : length])
        del data[:padded]
        yield VrpnMessage(sender, type, body)
