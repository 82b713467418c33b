# SPDX-License-Identifier: BSD-3-Clause
"""Callbacks of Zenoh that never raise: Zenoh would print the traceback, and a query would wait for its timeout."""

import logging
from collections.abc import Callable
from typing import TypeVar

log = logging.getLogger("camera_node.network")
T = TypeVar("T")


def guarded(
    purpose: str, callback: Callable[[T], object], count_fault: Callable[[], object] = lambda: None
) -> Callable[[T], None]:
    """The callback, whose exceptions are logged and counted.

    Args:
        purpose: the subject of the log line, such as "a callback for poses".
        callback: takes what Zenoh received.
        count_fault: is called after an exception.
    """

    def call(received: T) -> None:
        try:
            callback(received)
        except Exception:  # whatever a network can cause
            count_fault()
            log.exception("%s failed %s", purpose, getattr(received, "key_expr", ""))

    return call
