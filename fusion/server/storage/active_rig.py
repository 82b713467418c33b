# SPDX-License-Identifier: BSD-3-Clause
"""The active rig and the history of its changes: loads, saves, undoes and redoes them."""

import contextlib
import logging
import shutil
import tempfile
import time
import weakref
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Literal

import msgspec

from calib.rig.file_history import History, Step
from calib.rig.rig import Rig, dump_rig, load_rig, save_rig
from calib.rig.rig_messages import (
    MAX_CHANGE,
    MAX_VERSIONS,
    RigHistory,
    RigMessage,
    RigVersion,
    SavedChange,
    describe_change,
    file_digest,
    holds_rig,
    read_change,
    read_given,
    without_change,
)
from camera_node.foundation.config import write_atomically
from camera_node.foundation.errors import ConfigError, RoundelError
from camera_node.protocol.requests import RequestSource
from fusion.model.corrections import ExtrinsicsCorrection, RigRefinement, correct, is_corrected

log = logging.getLogger("fusion")
State = Literal["earlier", "in force", "undone"]


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
        self._digest = file_digest(given)  # in place of which rigs are saved from now on
        self._files: History | None = None
        self._remove_folder: Callable[[], object] = lambda: None
        self.message: RigMessage | None = None

    def close(self) -> None:
        """Remove the history of changes that last until the program ends."""
        self._remove_folder()

    @property
    def rig(self) -> Rig | None:
        """The rig in use."""
        return self.message.rig if self.message else None

    def load(self, apply: Callable[[Rig], object]) -> None:
        """Use the saved rig, or the given one if the user changed it after the other was saved.

        A saved rig that is broken, or to which `apply` raises, is logged, and the one before it is used.

        Raises:
            ConfigError, CalibrationError: the given file is missing or broken, and there is no saved rig.
        """
        for path in self.saved_rigs():
            try:
                rig = load_rig(path)
                apply(rig)
            except Exception as error:  # a saved rig must not prevent a start
                log.warning("the saved rig %s is not used, but the one before it: %s", path, error)
                continue
            log.info("using the rig that was last changed over the network: %s", path)
            self._record_given()
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

    def save(
        self, rig: Rig, now_ns: int, source: RequestSource | None = None, is_correction: bool = False
    ) -> None:
        """Save another rig as the next step of the history, with what it changes, when, and who asked for it.

        A file that the sender of the rig wrote before, as `calib` and the page do, is such a step already. Where the
        history is full, the server's corrections leave it first: a camera that is often moved displaces no calibration.

        Raises:
            ConfigError, CalibrationError: it can't be saved; the files hold the rig in use.
        """
        text = describe_change(self.rig, rig)[:MAX_CHANGE]
        change = SavedChange(
            t_ns=now_ns, change=text, source=source, is_correction=is_correction, given=self._digest
        ).line()
        path = self._history.path
        if not holds_rig(path, rig) or not self._is_in_history():
            self._save_active()
            self._history.make_room(lambda older: read_change(older).is_correction)
            save_rig(rig, path, change)
        elif rig != self.rig:
            write_atomically(path, change + dump_rig(rig))

    def rename(self, before: str, after: str) -> None:
        """Give a camera another name in the saved rig and in all versions of its history.

        A name is no calibration: an undo afterwards restores the poses before the last calibration, under the names of
        today. A version that is broken keeps the old name, which is logged.

        Raises:
            ConfigError: the saved rig can't be written; nothing is changed.
        """
        self._save_active()
        history = self._history
        _rename_in_file(history.path, before, after)
        for path in (*history.older(), *history.undone()):
            try:
                _rename_in_file(path, before, after)
            except RoundelError as error:
                log.warning("%s keeps the name %s of a camera that is now %s: %s", path, before, after, error)

    def _is_in_history(self) -> bool:
        """Whether undo or redo would restore the rig in use, which the saved file no longer holds."""
        files = [*self._history.older()[-1:], *self._history.undone()[-1:], self._history.path]
        return self.rig is None or any(holds_rig(path, self.rig) for path in files)

    def correct(self, correction: ExtrinsicsCorrection | RigRefinement, now_ns: int) -> None:
        """Use other poses of cameras. A fault of the disk is only logged."""
        assert self.rig is not None
        rig = correct(self.rig, correction, now_ns)
        saved = None
        try:
            self.save(rig, now_ns, is_correction=True)
        except RoundelError as error:
            log.warning("the corrected rig is used, but not saved for a restart: %s", error)
            saved = False
        self.use(rig, now_ns, saved=saved)

    def neighbour(self, step: Step) -> Rig:
        """The rig that a step restores.

        Raises:
            CalibrationError, ConfigError: there is none, or its file is broken.
        """
        if step == "undo" and self._history.path.exists():
            self._save_active()
        return load_rig(self._history.neighbour(step))

    def earlier(self) -> list[Rig]:
        """The rigs from the calibration on that the server's corrections changed, oldest first, to the one in use.

        The history may not reach as far; the rig of the configuration is the calibration then.
        """
        rigs = [self.rig] if self.rig is not None else []
        is_saved = self._saved is not None and self._saved.exists()
        files = [*reversed(self._history.older())] if is_saved else []
        for path in (*files, self._given):
            if path is None or not rigs or not is_corrected(rigs[-1]):
                break
            with contextlib.suppress(RoundelError):
                rigs.append(load_rig(path))
        return rigs[::-1]

    def neighbours(self) -> list[Rig]:
        """The rigs in the files to which undo and redo would go; those that can't be read are left out."""
        rigs = []
        for path in () if self._is_unsaved else (*self._history.older()[-1:], *self._history.undone()[-1:]):
            with contextlib.suppress(RoundelError):
                rigs.append(load_rig(path))
        return rigs

    def history(self) -> RigHistory:
        """All versions of the rig.

        Raises:
            ConfigError: a file can't be read.
        """
        if self.message is None:
            return RigHistory()
        older, undone = ([], []) if self._is_unsaved else (self._history.older(), self._history.undone())
        try:
            versions = [self._version(path, "earlier") for path in older]
            versions += [self._version_in_force(self.message)]
            versions += [self._version(path, "undone") for path in reversed(undone)]
        except OSError as error:
            raise ConfigError(f"the history of the rig can't be read: {error.strerror}") from None
        return RigHistory(rig_t_ns=self.message.t_ns, versions=tuple(versions[-MAX_VERSIONS:]))

    def _version(self, path: Path, state: State) -> RigVersion:
        change = read_change(path)
        file = path.name if self._saved is not None else ""
        return RigVersion(state=state, file=file, **msgspec.structs.asdict(change))

    def _version_in_force(self, message: RigMessage) -> RigVersion:
        """The rig in use; a rig of the configuration is in none of the files of the history."""
        if not self._is_unsaved and holds_rig(self._history.path, message.rig):
            return self._version(self._history.path, "in force")
        change = describe_change(None, message.rig)
        return RigVersion(state="in force", t_ns=message.t_ns, change=change, source=message.source)

    @property
    def _is_unsaved(self) -> bool:
        """Whether the rig was never saved or changed: it has no history yet."""
        return self._files is None and self._saved is None

    def take(self, step: Step) -> None:
        """Restore the file of that rig; raises as `neighbour`."""
        self._history.take(step)
        self._record_given()

    def _record_given(self) -> None:
        """Let the saved file say in place of which file it is used: a version of the history has another one."""
        path = self._saved
        if path is None or not path.exists() or read_given(path) == self._digest or not self._digest:
            return
        with contextlib.suppress(RoundelError, OSError):  # a folder that can't be written to: as it was
            change = msgspec.structs.asdict(read_change(path))
            body = without_change(path.read_text(encoding="utf-8"))
            write_atomically(path, SavedChange(**change, given=self._digest).line() + body)

    def _save_active(self) -> None:
        """Save the rig in use unless the saved file holds it: a rig of the configuration, or one that is newer."""
        if self.message is not None and not holds_rig(self._history.path, self.message.rig):
            rig, t_ns = self.message.rig, self.message.t_ns
            change = SavedChange(
                t_ns=t_ns, change=describe_change(None, rig), source=self.message.source, given=self._digest
            )
            save_rig(rig, self._history.path, change.line())

    @property
    def _history(self) -> History:
        """The history of the saved file, or of one in a temporary folder."""
        if self._files is None:
            self._files = History(self._saved or self._temporary_folder() / "rig.yaml")
        return self._files

    def _temporary_folder(self) -> Path:
        folder = tempfile.mkdtemp(prefix="roundel-rig-")
        self._remove_folder = weakref.finalize(self, shutil.rmtree, folder, ignore_errors=True)
        return Path(folder)

    def saved_rigs(self) -> Iterator[Path]:
        """The saved rig and those before it, newest first; none if the user changed the given file since then."""
        if self._saved is None or not self._saved.exists() or self._saved == self._given:
            return
        if was_changed_since(self._given, self._saved):
            return
        yield self._saved
        yield from reversed(self._history.older())


def renamed(rig: Rig, before: str, after: str) -> Rig:
    """The rig with another name for a camera; another entry of that name, which no camera has, is left out."""
    cameras = {
        name: camera for name, camera in rig.cameras.items() if name != after or before not in rig.cameras
    }
    names = {name: after if name == before else name for name in cameras}
    return msgspec.structs.replace(rig, cameras={names[name]: camera for name, camera in cameras.items()})


def _rename_in_file(path: Path, before: str, after: str) -> None:
    """Raises ConfigError or CalibrationError for a file that can't be read or written."""
    rig, change = load_rig(path), read_change(path)
    if before in rig.cameras:
        line = SavedChange(**msgspec.structs.asdict(change), given=read_given(path) or "").line()
        write_atomically(path, line + dump_rig(renamed(rig, before, after)))


def was_changed_since(given: Path | None, saved: Path) -> bool:
    """Whether the user changed the file `given` after the server wrote `saved`, which is logged.

    The saved file names the content that it replaces. Times of files don't decide: copies and clones have others.
    """
    digest, replaced = file_digest(given), read_given(saved)
    if replaced is None and digest:
        text = "using %s and not %s: no version says which one is newer. To use the other one, move %s away"
        log.warning(text, saved, given, saved)
        return False
    if replaced == digest or not digest:
        return False
    log.warning("using %s, which was changed after the server wrote %s; that one is kept", given, saved)
    return True
