# SPDX-License-Identifier: BSD-3-Clause
"""The rig in force: where it comes from, what corrects it, and how that is taken back and kept."""

import logging
from pathlib import Path

import msgspec

from calib.camera import Camera
from calib.rig import Rig, load_rig, save_rig
from camera_node.errors import RoundelError
from fusion.errors import FusionError

log = logging.getLogger("fusion")


class Calibration:
    """The rig in force, None until there is one; its corrections can be undone one by one."""

    def __init__(self, rig: Path | None, kept: Path | None) -> None:
        """The newer of the file that a person gave and the one in which a published rig was kept.

        Raises:
            ConfigError, CalibrationError: the file is missing or broken; of the kept one it is only told.
        """
        self._kept = kept
        self._corrected: list[tuple[str, Camera]] = []  # cameras before their corrections
        self.rig = self._load_kept(rig)
        if self.rig is None and rig is not None:
            self.rig = load_rig(rig)

    def _load_kept(self, rig: Path | None) -> Rig | None:
        if self._kept is None or not self._kept.exists():
            return None
        if rig is not None and rig.exists() and rig.stat().st_mtime >= self._kept.stat().st_mtime:
            log.info("%s is newer than %s, which is left alone", rig, self._kept)
            return None
        try:
            kept = load_rig(self._kept)
        except RoundelError as error:
            log.warning("the kept rig is not used: %s", error)
            return None
        log.info("the rig that was last published is in force: %s", self._kept)
        return kept

    def replace(self, rig: Rig) -> None:
        """Another rig is in force, and kept."""
        self.rig = rig
        self._corrected.clear()
        self._keep()

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
        self._keep()

    def _keep(self) -> None:
        if self._kept is None or self.rig is None:
            return
        try:
            save_rig(self.rig, self._kept)
        except RoundelError as error:
            log.warning("the rig is in force, but is not kept over a restart: %s", error)
