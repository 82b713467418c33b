# SPDX-License-Identifier: BSD-3-Clause
"""Mutations of valid messages, aware of their structure: a message is MessagePack, so a tree of maps and lists."""

import math
import random
import struct
from typing import Any

import msgspec

Path = tuple[Any, ...]
NUMBERS = (
    0,
    1,
    -1,
    2**31,
    2**63 - 1,
    -(2**63),
    2**64 - 1,
    1e308,
    -1e308,
    5e-324,
    math.nan,
    math.inf,
    -math.inf,
)
TEXTS = (
    "", " ", "a/b", "**", "../../etc/passwd", "\x00", "\x1b[2J\x1b[31m", "\r\nERROR forged", "‮txet", "\U0001f916",
    "x" * 10_000, "é" * 65, "%s%n", "null", "{", "&a [*a]",
)  # fmt: skip
BYTES = (
    b"",
    b"\x00",
    b"\xff" * 7,
    struct.pack("<d", math.nan) * 8,
    struct.pack("<d", 1e308) * 8,
    bytes(4096),
)
NESTED = (100, 1000, 50_000)  # depths
LARGEST = 1 << 24  # bytes of a column: mutations of mutations took all memory


def mutate(message: Any, rng: random.Random) -> bytes:
    """A valid message with one to three faults."""
    kind = rng.random()
    if kind < 0.05:
        return rng.choice(
            (rng.randbytes(rng.randrange(200)), nested(rng), b"\xdd\xff\xff\xff\xff", b"\xc1", b"")
        )
    message = clone(message)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        message = damage(message, rng)
    data = msgspec.msgpack.encode(message)
    return data[: rng.randrange(len(data) + 1)] if kind < 0.10 else data


def certainly_invalid(message: Any, rng: random.Random) -> bytes:
    """Bytes that no decoder may accept: cut off, random, or of an unknown version."""
    data = msgspec.msgpack.encode(message)
    wrong = msgspec.msgpack.encode({**message, "version": 10**6})
    return rng.choice((data[: rng.randrange(len(data))], b"\xc1" + rng.randbytes(50), nested(rng), wrong))


def damage(message: Any, rng: random.Random) -> Any:
    """Change one value of a tree; the tree itself may be replaced."""
    path = rng.choice(paths(message))
    if not path:
        return damaged_value(message, rng)
    parent = message
    for step in path[:-1]:
        parent = parent[step]
    value = parent[path[-1]]
    if isinstance(parent, dict) and rng.random() < 0.15:
        del parent[path[-1]]
        if rng.random() < 0.5:
            parent[odd_text(rng)] = value
    else:
        parent[path[-1]] = damaged_value(value, rng)
    return message


def damaged_value(value: Any, rng: random.Random) -> Any:
    """A value near the given one, or of another type."""
    if rng.random() < 0.3:
        return odd_value(rng)
    if isinstance(value, bytes):
        return damaged_bytes(value, rng)
    if isinstance(value, str):
        return odd_text(rng)
    if isinstance(value, bool) or value is None:
        return odd_value(rng)
    if isinstance(value, int | float):
        return rng.choice(NUMBERS)
    if isinstance(value, list):
        return rng.choice((value[:-1], value + value, value * 500, []))
    if not isinstance(value, dict):
        return odd_value(rng)
    return {**value, odd_text(rng): odd_value(rng)}


def damaged_bytes(value: bytes, rng: random.Random) -> bytes:
    """A column of the wrong size, or with numbers that are not finite or not plausible."""
    if not value or rng.random() < 0.3:
        longer = value * min(100, 1 + LARGEST // len(value)) if value else b""
        return rng.choice((*BYTES, value[:-1], value + value, longer))
    size = rng.choice((4, 8))
    number = struct.pack(
        "<f" if size == 4 else "<d", rng.choice((math.nan, math.inf, -1e30, 0.0, 1e-30, 3e38))
    )
    at = rng.randrange(len(value))
    return (value[:at] + number + value[at + size :])[: len(value)]


def odd_value(rng: random.Random) -> Any:
    """Some value of some type."""
    return rng.choice((None, True, [], {}, [[]], rng.choice(NUMBERS), rng.choice(BYTES), odd_text(rng)))


def odd_text(rng: random.Random) -> str:
    return rng.choice(TEXTS) if rng.random() < 0.9 else "".join(map(chr, rng.choices(range(0x500), k=20)))


def nested(rng: random.Random) -> bytes:
    """Lists in lists."""
    depth = rng.choice(NESTED)
    return rng.choice((b"\x91", b"\x81\xa0")) * depth + b"\xc0"


def paths(message: Any, limit: int = 400) -> list[Path]:
    """The ways to the values of a tree; () is the tree itself."""
    found: list[Path] = [()]
    for path in found:
        value = message
        for step in path:
            value = value[step]
        steps = (
            value.keys() if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
        )
        found.extend((*path, step) for step in list(steps)[:20])
        if len(found) > limit:
            break
    return found


def clone(message: Any) -> Any:
    """A copy whose maps and lists are its own."""
    if isinstance(message, dict):
        return {key: clone(value) for key, value in message.items()}
    return [clone(value) for value in message] if isinstance(message, list) else message
