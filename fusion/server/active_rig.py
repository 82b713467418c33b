# SPDX-License-Identifier: BSD-3-Clause
"""The rig in force: where it comes from, what corrects it, and how that is taken back and kept."""

from pathlib import Path

import msgspec

from calib.rig.camera import Camera
from calib.rig.messages import RigMessage
from calib.rig.rig import Rig, load_rig
from fusion.errors import FusionError
from fusion.server.persistence import PersistedFile


class ActiveRig:
    """The rig in force, None until there is one; its corrections can be undone one by one."""

    def __init__(self, rig: Path | None, kept: PersistedFile[Rig]) -> None:
        """The newer of the file that a person gave and the one in which a published rig was kept.

        Raises:
            ConfigError, CalibrationError: the file is missing or broken; of the kept one it is only told.
        """
        self._kept = kept
        self._corrected: list[tuple[str, Camera]] = []  # cameras before their corrections
        self.rig = kept.newer_than(rig)
        if self.rig is None and rig is not None:
            self.rig = load_rig(rig)

    def replace(self, rig: Rig) -> str | None:
        """Another rig is in force, and kept; the camera in which alone it differs from the old one, if it does."""
        old, self.rig = self.rig, rig
        self._corrected.clear()
        self._kept.keep(rig)
        if old is None or rig.placed().keys() != old.placed().keys():
            return None
        moved = [name for name in rig.cameras if rig.cameras[name] != old.cameras.get(name)]
        return moved[0] if len(moved) == 1 else None

    def message(self) -> RigMessage:
        """The rig in force, of which there is one, as a message."""
        assert self.rig is not None
        return RigMessage.of(self.rig)

    def correct(self, name: str, camera: Camera) -> None:
        """A camera stands elsewhere."""
        assert self.rig is not None
        self._corrected.append((name, self.rig.cameras[name]))
        self._place(name, camera)

    def undo(self) -> tuple[str, Camera]:
        """Take the last correction back; the camera and where it stood before.

        Raises:
            FusionError: there is none.
        """
        if not self._corrected:
            raise FusionError(
                "no camera was placed anew since the rig came into force; there is nothing to undo"
            )
        name, camera = self._corrected.pop()
        self._place(name, camera)
        return name, camera

    def _place(self, name: str, camera: Camera) -> None:
        assert self.rig is not None
        self.rig = msgspec.structs.replace(self.rig, cameras={**self.rig.cameras, name: camera})
        self._kept.keep(self.rig)
