# SPDX-License-Identifier: BSD-3-Clause
"""Addresses of network streams, and their text without credentials."""

import re

URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


def is_url(source: str) -> bool:
    """Whether the value of `--source` is the address of a network stream, such as rtsp://host/stream."""
    return URL.match(source) is not None


def without_credentials(source: str) -> str:
    """A source as it may be printed: user and password before the last `@`, and the query, are replaced by `***`.

    Everything before the last `@` counts as credentials, because users do not escape `/`, `?` or `@` in a password.
    """
    scheme = match.group() if (match := URL.match(source)) else ""
    _, at, rest = source[len(scheme) :].rpartition("@")
    path, query, _ = rest.partition("?")
    return f"{scheme}{'***@' * bool(at)}{path}{'?***' * bool(query)}"
