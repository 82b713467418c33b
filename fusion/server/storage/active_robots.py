# SPDX-License-Identifier: BSD-3-Clause
"""The robots in use: the file that the user writes, and the one that saves changes made over the network."""

import logging
import time
from pathlib import Path

from calib.rig.file_history import History
from calib.rig.rig_messages import SavedChange, file_digest
from camera_node.foundation.errors import ConfigError, RoundelError
from fusion.model.robots import Robot, changed, load_robots, load_saved_robots, require_trackable, save_robots
from fusion.protocol.pose_messages import RobotsRequest
from fusion.server.storage.active_rig import was_changed_since

log = logging.getLogger("fusion")


class ActiveRobots:
    """The robots in use. Faults of the file that saves them are logged and never fatal.

    Args:
        given: robots.yaml; None to `follow` another server.
        saved: the file that saves changed robots; if it is `given`, it may be missing or empty. None saves nothing.

    Attributes:
        robots: by name; replaced as a whole.

    Raises:
        ConfigError, FusionError: the given file is missing or broken, or declares robots that can't be tracked.
    """

    def __init__(self, given: Path | None, saved: Path | None) -> None:
        self._given, self._saved = given, saved
        self._given_digest = file_digest(given)
        self._known = file_digest(saved)  # of the saved file as this server read or wrote it
        self._is_superseded = False  # the saved file is not in use: it is kept under a number
        self.robots = self._load(given)
        self._durable = self.robots  # those that a restart would load

    def follow(self, robots: dict[str, Robot]) -> None:
        """Use the robots of another server, which saves them.

        Raises:
            FusionError: they can't be tracked.
        """
        require_trackable(robots, "robots of the first zone", self.robots.keys())
        self.robots = self._durable = robots

    def _load(self, given: Path | None) -> dict[str, Robot]:
        """The saved robots, or the given ones if the user changed them after the others were saved."""
        if given is None:
            return {}
        if self._saved == given:
            return load_saved_robots(given) if given.exists() else {}
        if self._saved is None or not self._saved.exists():
            if not given.exists():
                raise ConfigError(
                    f"{given} does not exist; give --robots, or run roundel up, which needs no file"
                )
            return load_robots(given)
        self._is_superseded = was_changed_since(given, self._saved)
        if self._is_superseded:
            return load_robots(given)
        try:
            saved = load_saved_robots(self._saved)
        except RoundelError as error:
            log.warning("the saved robots are not used: %s", error)
            self._is_superseded = True
            return load_robots(given)
        log.info("using the robots that were last changed over the network: %s", self._saved)
        return saved

    def change(self, request: RobotsRequest) -> bool:
        """Rename, remove and define robots, all or none, and save them; return whether that changes anything.

        What a user edited in the saved file since it was read comes first: nothing of it is overwritten.

        Raises:
            ConfigError, FusionError: the request is invalid, or the file was edited and is broken.
        """
        present = self._with_edits()
        robots = changed(present, request.rename, request.remove, request.define, request.replace)
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

    def _with_edits(self) -> dict[str, Robot]:
        """The robots in use, with what the saved file says of those that were edited in it since it was read."""
        path, digest = self._saved, file_digest(self._saved)
        if path is None or not digest or digest == self._known:
            return self.robots
        try:
            edited = load_saved_robots(path)
            names = self._durable.keys() | edited.keys()
            differing = sorted(name for name in names if self._durable.get(name) != edited.get(name))
            kept = {name: robot for name, robot in self.robots.items() if name not in differing}
            robots = kept | {name: edited[name] for name in differing if name in edited}
            require_trackable(robots, str(path), kept.keys())
        except RoundelError as error:
            raise ConfigError(
                f"{path} was edited while the server runs, and can't be used: {error}; correct it, and repeat. "
                "Nothing was changed"
            ) from None
        log.warning("%s was edited while the server runs: %s as edited", path, ", ".join(differing) or "none")
        return robots

    def _save(self, robots: dict[str, Robot]) -> None:
        path = self._saved
        if path is None:
            return
        try:
            if self._is_superseded:
                log.warning("robots that were saved before are kept in %s", History(path).back_up())
                self._is_superseded = False
            is_own = path != self._given
            line = SavedChange(t_ns=time.time_ns(), given=self._given_digest).line() if is_own else ""
            save_robots(robots, path, line)
        except RoundelError as error:
            log.warning("the robots are used, but not saved for a restart: %s", error)
        else:
            self._durable, self._known = robots, file_digest(path)

    def unsaved(self) -> tuple[str, ...]:
        """Names of the robots that a restart would lose, change or bring back."""
        names = sorted(self.robots.keys() | self._durable.keys())
        return tuple(name for name in names if self.robots.get(name) != self._durable.get(name))
