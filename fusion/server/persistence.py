# SPDX-License-Identifier: BSD-3-Clause
"""What was told over the network and outlives a restart: a file beside the one that a person gave."""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Generic, TypeVar

from camera_node.errors import RoundelError

log = logging.getLogger("fusion")
T = TypeVar("T")


class PersistedFile(Generic[T]):
    """A file that the server writes; faults with it are told and never fatal.

    Args:
        what: the word for it, as in "the kept rig".
        path: the file; None keeps nothing.
        load, save: read and write it, raising RoundelError.
    """

    def __init__(
        self, what: str, path: str | None, load: Callable[[Path], T], save: Callable[[T, Path], object]
    ) -> None:
        self._what, self._path = what, Path(path) if path else None
        self._load, self._save = load, save

    def newer_than(self, given: Path | None) -> T | None:
        """What was kept, unless it is not there, broken, or older than the file that a person gave."""
        if self._path is None or not self._path.exists():
            return None
        if given is not None and given.exists() and given.stat().st_mtime >= self._path.stat().st_mtime:
            log.info("%s is newer than %s, which is left alone", given, self._path)
            return None
        try:
            kept = self._load(self._path)
        except RoundelError as error:
            log.warning("the kept %s is not used: %s", self._what, error)
            return None
        log.info("the %s that was last told over the network is in force: %s", self._what, self._path)
        return kept

    def keep(self, now: T) -> None:
        """Let it be in force after a restart, too."""
        if self._path is None:
            return
        try:
            self._save(now, self._path)
        except RoundelError as error:
            log.warning("the %s is in force, but is not kept over a restart: %s", self._what, error)
