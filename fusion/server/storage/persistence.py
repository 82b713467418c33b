# SPDX-License-Identifier: BSD-3-Clause
"""Files that the server writes, so that changes made over the network survive a restart."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from camera_node.foundation.errors import RoundelError

log = logging.getLogger("fusion")
T = TypeVar("T")


def is_newer(given: Path | None, saved: Path) -> bool:
    """Whether the user wrote the file `given` after the server wrote the file `saved`."""
    return given is not None and given.exists() and given.stat().st_mtime >= saved.stat().st_mtime


class PersistedFile(Generic[T]):
    """A file that the server writes, beside the one that the user writes. Its faults are logged and never fatal.

    Args:
        content: the word for the content in messages, as in "the saved robots".
        path: the file; None saves nothing.
        load: reads it; raises RoundelError.
        save: writes it; raises RoundelError.
    """

    def __init__(
        self, content: str, path: str | None, load: Callable[[Path], T], save: Callable[[T, Path], object]
    ) -> None:
        self._content, self._path = content, Path(path) if path else None
        self._load, self._save = load, save

    def load_if_newer(self, given: Path) -> T | None:
        """The saved content; None if there is none, if it is broken, or if the user's file `given` is newer."""
        if self._path is None or not self._path.exists():
            return None
        if is_newer(given, self._path):
            log.info("using %s, which is newer than %s", given, self._path)
            return None
        try:
            saved = self._load(self._path)
        except RoundelError as error:
            log.warning("the saved %s is not used: %s", self._content, error)
            return None
        log.info("using the %s that was last changed over the network: %s", self._content, self._path)
        return saved

    def save(self, value: T) -> bool:
        """Write the file; return whether the value survives a restart."""
        if self._path is None:
            return False
        try:
            self._save(value, self._path)
        except RoundelError as error:
            log.warning("the %s is used, but not saved for a restart: %s", self._content, error)
            return False
        return True
