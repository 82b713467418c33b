# SPDX-License-Identifier: BSD-3-Clause
"""The robots in use: the file that the user writes, and the one that saves changes made over the network."""

import logging
from pathlib import Path

from camera_node.foundation.errors import RoundelError
from fusion.model.robots import Robot, changed, load_robots, load_saved_robots, save_robots
from fusion.protocol.pose_messages import RobotsRequest
from fusion.server.storage.active_rig import is_newer

log = logging.getLogger("fusion")


class ActiveRobots:
    """The robots in use. Faults of the file that saves them are logged and never fatal.

    Args:
        given: robots.yaml.
        saved: the file that saves changed robots; if it is `given`, it may be missing or empty. None saves nothing.

    Attributes:
        robots: by name; replaced as a whole.

    Raises:
        ConfigError, FusionError: the given file is missing or broken, or declares robots that can't be tracked.
    """

    def __init__(self, given: Path, saved: Path | None) -> None:
        self._saved = saved
        self.robots = self._load(given)
        self._durable = self.robots  # those that a restart would load

    def _load(self, given: Path) -> dict[str, Robot]:
        """The newer of the given and the saved robots."""
        if self._saved == given:
            return load_saved_robots(given) if given.exists() else {}
        if self._saved is None or not self._saved.exists():
            return load_robots(given)
        if is_newer(given, self._saved):
            log.info("using %s, which is newer than %s", given, self._saved)
            return load_robots(given)
        try:
            saved = load_saved_robots(self._saved)
        except RoundelError as error:
            log.warning("the saved robots are not used: %s", error)
            return load_robots(given)
        log.info("using the robots that were last changed over the network: %s", self._saved)
        return saved

    def change(self, request: RobotsRequest) -> bool:
        """Rename, remove and define robots, all or none, and save them; return whether that changes anything.

        Raises:
            ConfigError, FusionError: the request is invalid.
        """
        robots = changed(self.robots, request.rename, request.remove, request.define, request.replace)
        if robots == self.robots:
            return False
        self.robots = robots
        self._save(robots)
        log.info("robots: %s", ", ".join(robots) or "none")
        if unsaved := self.unsaved():
            log.warning(
                "a restart undoes the changes of %s: arena.yaml names no saved_robots", ", ".join(unsaved)
            )
        return True

    def _save(self, robots: dict[str, Robot]) -> None:
        if self._saved is None:
            return
        try:
            save_robots(robots, self._saved)
        except RoundelError as error:
            log.warning("the robots are used, but not saved for a restart: %s", error)
        else:
            self._durable = robots

    def unsaved(self) -> tuple[str, ...]:
        """Names of the robots that a restart would lose, change or bring back."""
        names = sorted(self.robots.keys() | self._durable.keys())
        return tuple(name for name in names if self.robots.get(name) != self._durable.get(name))
