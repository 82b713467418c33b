# SPDX-License-Identifier: BSD-3-Clause
"""The active rig and the history of its changes: loads, saves, undoes and redoes them."""

import atexit
import logging
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from calib.rig.camera import Camera
from calib.rig.history import History
from calib.rig.messages import RigMessage
from calib.rig.rig import Rig, dump_rig, load_rig, save_rig
from camera_node.errors import RoundelError
from camera_node.protocol.requests import RequestSource
from fusion.model.corrections import correct
from fusion.server.storage.persistence import is_newer

log = logging.getLogger("fusion")


class ActiveRig:
    """The rig in use, None before there is one. Every change is a step of its history, which can be undone and redone.

    Args:
        given: the rig file of the configuration, if there is one; it is never written.
        saved: the file that saves changed rigs, with their history beside it. Without one, changes and their history
            last until the program ends.

    Attributes:
        message: the rig in use, for the network; replaced as a whole, so that any thread may read it.
    """

    def __init__(self, given: Path | None, saved: Path | None) -> None:
        self._given, self._saved = given, saved
        self._files: History | None = None
        self.message: RigMessage | None = None

    @property
    def rig(self) -> Rig | None:
        """The rig in use."""
        return self.message.rig if self.message else None

    def load(self, apply: Callable[[Rig], object]) -> None:
        """Use the newer of the saved and the given rig.

        A saved rig that is broken, or to which `apply` raises, is logged, and the one before it is used.

        Raises:
            ConfigError, CalibrationError: the given file is missing or broken, and there is no saved rig.
        """
        for path in self._saved_rigs():
            try:
                rig = load_rig(path)
                apply(rig)
            except Exception as error:  # a saved rig must not prevent a start
                log.warning("the saved rig %s is not used, but the one before it: %s", path, error)
                continue
            log.info("using the rig that was last changed over the network: %s", path)
            self.message = RigMessage(t_ns=time.time_ns(), rig=rig, saved=True)
            return
        if self._given is not None:
            rig = load_rig(self._given)
            apply(rig)
            self.message = RigMessage(t_ns=time.time_ns(), rig=rig, saved=True)

    def use(
        self, rig: Rig, now_ns: int, source: RequestSource | None = None, saved: bool | None = None
    ) -> None:
        """Use a rig from now on. Without `saved`, it counts as saved if the server has a file for rigs."""
        is_saved = self._saved is not None if saved is None else saved
        self.message = RigMessage(t_ns=now_ns, rig=rig, saved=is_saved, source=source)

    def save(self, rig: Rig) -> None:
        """Save another rig as the next step of the history.

        Raises:
            ConfigError, CalibrationError: it can't be saved; the files hold the rig in use.
        """
        self._save_active()
        save_rig(rig, self._history.path)

    def correct(self, name: str, camera: Camera, now_ns: int) -> None:
        """Use a new pose of a camera that was moved. A fault of the disk is only logged."""
        assert self.rig is not None
        rig = correct(self.rig, name, camera, now_ns)
        saved = None
        try:
            self.save(rig)
        except RoundelError as error:
            log.warning("the corrected rig is used, but not saved for a restart: %s", error)
            saved = False
        self.use(rig, now_ns, saved=saved)

    def previous(self) -> Rig:
        """The rig that `undo` restores.

        Raises:
            CalibrationError, ConfigError: there is none, or its file is broken.
        """
        if self._history.path.exists():
            self._save_active()
        return load_rig(self._history.previous())

    def next(self) -> Rig:
        """The rig that `redo` restores; raises as `previous`."""
        return load_rig(self._history.next())

    def undo(self) -> None:
        """Restore the file of the previous rig; raises as `previous`."""
        self._history.undo()

    def redo(self) -> None:
        """Restore the file of the rig that was undone last; raises as `previous`."""
        self._history.redo()

    def _save_active(self) -> None:
        """Save the rig in use unless the saved file holds it: a rig of the configuration, or one that is newer."""
        if self.rig is not None and not _holds(self._history.path, self.rig):
            save_rig(self.rig, self._history.path)

    @property
    def _history(self) -> History:
        """The history of the saved file, or of one in a temporary folder."""
        if self._files is None:
            self._files = History(self._saved or _temporary_folder() / "rig.yaml")
        return self._files

    def _saved_rigs(self) -> Iterator[Path]:
        """The saved rig and those before it, newest first; none if the user's file is newer."""
        if self._saved is None or not self._saved.exists():
            return
        if is_newer(self._given, self._saved):
            log.info("using %s, which is newer than %s", self._given, self._saved)
            return
        yield self._saved
        yield from reversed(self._history.older())


def _holds(path: Path, rig: Rig) -> bool:
    """Whether a file holds a rig, as `save_rig` writes it."""
    try:
        return path.read_text(encoding="utf-8") == dump_rig(rig)
    except (OSError, UnicodeDecodeError):
        return False


def _temporary_folder() -> Path:
    folder = tempfile.mkdtemp(prefix="roundel-rig-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)
