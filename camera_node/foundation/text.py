# SPDX-License-Identifier: BSD-3-Clause
"""Text from files and networks, made safe for one line of a terminal or a log."""

MAX_LINE = 500  # characters of one message


def printable(text: object, limit: int = MAX_LINE) -> str:
    """A text on one line: what is not printable is escaped, and what exceeds `limit` characters is left out."""
    shown = str(text)[: limit + 1]
    escaped = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return escaped if len(escaped) <= limit else escaped[:limit] + "..."
