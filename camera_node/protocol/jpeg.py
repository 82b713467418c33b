# SPDX-License-Identifier: BSD-3-Clause
"""Reads the size of a JPEG without decoding it: a few kilobytes can declare an image of many gigabytes."""

START = b"\xff\xd8"
SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start of frame, ITU-T T.81 table B.1
SIZE_BYTES = 9  # of a start of frame until its width


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a JPEG declares; None for anything else."""
    if not data.startswith(START):
        return None
    at = len(START)
    while at + SIZE_BYTES <= len(data) and data[at] == 0xFF:
        if data[at + 1] in SIZE_MARKERS:
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            return (width, height) if width and height else None
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None
