# SPDX-License-Identifier: BSD-3-Clause
"""The active rig: loads, replaces, corrects and saves it, and undoes corrections."""

from pathlib import Path

import msgspec

from calib.rig.camera import Camera
from calib.rig.messages import RigMessage
from calib.rig.rig import Rig, load_rig
from fusion.errors import FusionError
from fusion.server.persistence import PersistedFile


class ActiveRig:
    """The rig in use, None before there is one. Its corrections can be undone one by one.

    Args:
        path: the rig file of the configuration, if there is one.
        saved: the file that saves a rig that was published or corrected; the newer of both files is used.

    Raises:
        ConfigError, CalibrationError: the file at `path` is missing or broken. A broken saved file is only logged.
    """

    def __init__(self, path: Path | None, saved: PersistedFile[Rig]) -> None:
        self._saved = saved
        self._before_corrections: list[tuple[str, Camera]] = []
        self.rig = saved.load_if_newer(path)
        if self.rig is None and path is not None:
            self.rig = load_rig(path)

    def replace(self, rig: Rig) -> str | None:
        """Activate and save another rig.

        Returns:
            The only camera that differs from the old rig; None if several differ, or the placed cameras are others.
        """
        old, self.rig = self.rig, rig
        self._before_corrections.clear()
        self._saved.save(rig)
        if old is None or rig.placed().keys() != old.placed().keys():
            return None
        changed = [name for name in rig.cameras if rig.cameras[name] != old.cameras.get(name)]
        return changed[0] if len(changed) == 1 else None

    def message(self) -> RigMessage:
        """The active rig, which must exist, as a message."""
        assert self.rig is not None
        return RigMessage.of(self.rig)

    def correct(self, name: str, camera: Camera) -> None:
        """Set a new pose of a camera that was moved."""
        assert self.rig is not None
        self._before_corrections.append((name, self.rig.cameras[name]))
        self._set_camera(name, camera)

    def undo(self) -> tuple[str, Camera]:
        """Undo the last correction.

        Returns:
            The camera's name, and the camera as it was before.

        Raises:
            FusionError: there is no correction.
        """
        if not self._before_corrections:
            raise FusionError(
                "no camera was recalibrated since the active rig was loaded; there is nothing to undo"
            )
        name, camera = self._before_corrections.pop()
        self._set_camera(name, camera)
        return name, camera

    def _set_camera(self, name: str, camera: Camera) -> None:
        assert self.rig is not None
        self.rig = msgspec.structs.replace(self.rig, cameras={**self.rig.cameras, name: camera})
        self._saved.save(self.rig)
