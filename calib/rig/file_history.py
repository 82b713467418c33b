# SPDX-License-Identifier: BSD-3-Clause
"""The numbered history of a file: older versions in `rig.1.yaml`, `rig.2.yaml`, ..., undone ones in
`rig.undone.1.yaml`, ..., both newest last."""

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from calib.errors import CalibrationError
from camera_node.foundation.config import new_path
from camera_node.foundation.errors import ConfigError, describe_failed_write

MAX_OLD = 20  # versions that are kept
Step = Literal["undo", "redo"]


@dataclass(frozen=True)
class HistoryStep:
    """An undo or a redo: the numbered file that was restored, which no longer exists, and the numbered file of the
    version that it replaced, None if there was none."""

    restored: Path
    replaced: Path | None


class History:
    """The older and the undone versions of a file, beside it.

    No version is overwritten. Each step first gives the file a second name and then replaces it, both atomically, so a
    process that is killed leaves a valid file and all versions; a copy that it leaves is removed by the next step. The
    oldest versions beyond `MAX_OLD` are removed when a version is added.

    All methods raise ConfigError if the folder does not exist or can't be written to.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._older, self._undone = _Series(path, ""), _Series(path, ".undone")

    def older(self) -> list[Path]:
        """The older versions, newest last."""
        return self._older.files()

    def undone(self) -> list[Path]:
        """The undone versions; a redo restores the last one."""
        return self._undone.files()

    def back_up(self) -> Path | None:
        """Give the file a number, before it is replaced. Undone versions become older ones, which an undo reaches.

        Returns:
            the numbered file; None if there is no file.
        """
        with self._reporting("backed up"):
            if not self.path.exists():
                return None
            for undone in self._undone.files():
                self._older.add(undone)
                undone.unlink()
            backup = self._older.add(self.path)
            for oldest in self._older.files()[:-MAX_OLD]:
                oldest.unlink()
            return backup

    def make_room(self, is_minor: Callable[[Path], bool]) -> None:
        """Remove the oldest version for which `is_minor`, if the next one would displace the oldest of all."""
        with self._reporting("backed up"):
            older = self._older.files()
            if len(older) >= MAX_OLD and (minor := next(filter(is_minor, older), None)):
                minor.unlink()

    def neighbour(self, step: Step) -> Path:
        """The version that a step restores: the previous one, or the one that was undone last.

        Raises:
            CalibrationError: there is none.
        """
        series, word = (self._older, "earlier") if step == "undo" else (self._undone, "undone")
        with self._reporting("restored"):
            files = series.files()
            while files and _are_equal(files[-1], self.path):  # a copy from a step that was interrupted
                files.pop().unlink()
        if not files:
            raise CalibrationError(f"there is no {word} version of {self.path}; nothing was changed")
        return files[-1]

    def take(self, step: Step) -> HistoryStep:
        """Restore the version of a step; raises as `neighbour`."""
        version, other = self.neighbour(step), self._undone if step == "undo" else self._older
        with self._reporting("restored"):
            replaced = other.add(self.path) if self.path.exists() else None
            os.replace(version, self.path)
        return HistoryStep(version, replaced)

    @contextlib.contextmanager
    def _reporting(self, verb: str) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise ConfigError(f"{self.path} can't be {verb}: {describe_failed_write(error)}") from None


class _Series:
    """The numbered files beside `path`: `rig.yaml` with the suffix ".undone" has `rig.undone.1.yaml`, ..."""

    def __init__(self, path: Path, suffix: str) -> None:
        self._folder, self._stem, self._end = path.parent, path.stem + suffix, path.suffix

    def files(self) -> list[Path]:
        """The files by their numbers."""
        pattern = re.compile(rf"{re.escape(self._stem)}\.([0-9]{{1,9}}){re.escape(self._end)}")
        found = [(int(m[1]), p) for p in self._folder.iterdir() if (m := pattern.fullmatch(p.name))]
        return [p for _, p in sorted(found)]

    def add(self, path: Path) -> Path:
        """Give a file the next number, unless the last numbered file is equal; returns the numbered file."""
        last = self.files()[-1:]
        if last and _are_equal(last[0], path):
            return last[0]
        number = int(last[0].name.removesuffix(self._end).rsplit(".", 1)[1]) + 1 if last else 1
        target = self._folder / f"{self._stem}.{number}{self._end}"
        _link_or_copy(path, target)
        return target


def _are_equal(a: Path, b: Path) -> bool:
    """Whether both files exist and have the same content."""
    if not (a.exists() and b.exists()):
        return False
    return a.samefile(b) or (a.stat().st_size == b.stat().st_size and a.read_bytes() == b.read_bytes())


def _link_or_copy(path: Path, target: Path) -> None:
    """Give a file a second name, atomically and never over another file; copy where the disk has no hard links."""
    try:
        os.link(path, target)
    except FileExistsError:
        raise
    except OSError:
        with new_path(target) as part:
            shutil.copy2(path, part)
