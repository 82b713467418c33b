# SPDX-License-Identifier: BSD-3-Clause
"""The cameras of an arena: their names and settings, one file `cameras/<name>.yaml` each.

The files are read again when they change, so that an editor and the network change the same ones.
"""

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec

from camera_node.foundation.config import dump_yaml, is_name, load_yaml, write_atomically
from camera_node.foundation.errors import ConfigError
from camera_node.protocol.messages import Settings
from camera_node.protocol.registration import CameraChange, CameraRegistration, RegisteredCamera
from camera_node.protocol.requests import RequestError

log = logging.getLogger("fusion.cameras")
MAX_CAMERAS = 64  # as many as a rig of 1 MiB holds with room to spare


class _CameraFile(msgspec.Struct, frozen=True, omit_defaults=True):
    """A `RegisteredCamera` as it is written: without settings that are not set."""

    id: str
    driver: str = ""
    source: str = ""
    width: int = 0
    height: int = 0
    settings: dict[str, Any] = {}

    @classmethod
    def of(cls, camera: RegisteredCamera) -> "_CameraFile":
        fields = msgspec.structs.asdict(camera)
        settings = msgspec.structs.asdict(fields.pop("settings"))
        given = {name: value for name, value in settings.items() if value is not None and name != "version"}
        return cls(**fields, settings=given)


class CameraRegistry:
    """Gives cameras their names, and stores names and settings.

    Args:
        folder: of the files, created with the first camera; None to store nothing beyond the end of the program.
        is_used: whether a camera, by its name, sends frames or is in the rig. Where the list is full, a camera that is
            not used and has no settings is forgotten for a new one, the one that registered first.
    """

    def __init__(self, folder: Path | None, is_used: Callable[[str], bool] = lambda name: True) -> None:
        self._folder, self._is_used = folder, is_used
        self._registered: dict[
            str, None
        ] = {}  # the cameras that registered since the start, the last one last
        self._cameras: dict[str, RegisteredCamera] = {}
        self._read_at: dict[str, int] = {}  # modification time of each file, ns

    def cameras(self) -> dict[str, RegisteredCamera]:
        """All cameras by name. A file that is broken or a duplicate is logged and left out."""
        if self._folder is not None:
            self._refresh(self._folder)
        return dict(sorted(self._cameras.items()))

    def register(self, request: CameraRegistration) -> str:
        """The name of a camera: the one it has, the one it proposes, or the first free `camera-<number>`.

        Raises:
            RequestError: there are too many cameras.
            ConfigError: its file can't be written.
        """
        cameras = self.cameras()
        name = next((name for name, camera in cameras.items() if camera.id == request.id), "")
        if not name and len(cameras) >= MAX_CAMERAS and not self._forget_unused(cameras):
            raise RequestError(
                f"{MAX_CAMERAS} cameras are registered; forget one that is no longer used (roundel cameras forget)"
            )
        settings = cameras[name].settings if name else Settings()
        camera = RegisteredCamera(
            id=request.id,
            driver=request.driver,
            source=request.source,
            width=request.width,
            height=request.height,
            settings=settings,
        )
        if not name:
            cameras = self.cameras()
            name = request.name if request.name and request.name not in cameras else _free_name(cameras)
        self._registered.pop(name, None)
        self._registered[name] = None
        if camera != cameras.get(name):
            self._write(name, camera)
        return name

    def _forget_unused(self, cameras: dict[str, RegisteredCamera]) -> bool:
        """Forget a camera that only registered, if there is one; those of an earlier start first."""
        order = {name: k for k, name in enumerate(self._registered)}
        unused = [
            n for n, camera in cameras.items() if camera.settings == Settings() and not self._is_used(n)
        ]
        if not unused:
            return False
        name = min(unused, key=lambda name: order.get(name, -1))
        log.warning("camera %s, which sends no frames, is forgotten: %d are registered", name, len(cameras))
        self._remove(name)
        return True

    def find(self, camera: str) -> str:
        """The name of a camera that is given by its name or id; raises RequestError if there is none."""
        cameras = self.cameras()
        by_id = {entry.id: name for name, entry in cameras.items()}
        name = camera if camera in cameras else by_id.get(camera)
        if name is None:
            raise RequestError(
                f"no camera '{camera}' is registered; there are: {', '.join(cameras) or 'none'}"
            )
        return name

    def require_free(self, name: str) -> None:
        """Raise RequestError if a camera has this name."""
        _require_free(self.cameras(), name)

    def change(self, name: str, request: CameraChange) -> str:
        """Rename a camera, store its settings or forget it; return its name afterwards.

        Raises:
            RequestError: the new name is taken.
            ConfigError: a file can't be written.
        """
        camera = self.cameras()[name]
        if request.forget:
            self._remove(name)
            return name
        after = request.name or name
        if after != name:
            self.require_free(after)
        changed = msgspec.structs.replace(camera, settings=merged(camera.settings, request.settings))
        if after != name or changed != camera:
            self._write(after, changed)
        if after != name:
            self._remove(name)
        return after

    def _refresh(self, folder: Path) -> None:
        """Read the files that are new or have changed."""
        found = {path.stem: path for path in sorted(folder.glob("*.yaml"))[: 2 * MAX_CAMERAS]}
        self._cameras = {name: camera for name, camera in self._cameras.items() if name in found}
        self._read_at = {name: t_ns for name, t_ns in self._read_at.items() if name in found}
        for name, path in found.items():
            try:
                t_ns = path.stat().st_mtime_ns
                if self._read_at.get(name) != t_ns:
                    self._read_at[name] = t_ns
                    self._cameras.pop(name, None)
                    self._cameras[name] = self._load(name, path)
            except (ConfigError, OSError) as error:
                log.warning("a file of a camera is not used: %s", error)

    def _load(self, name: str, path: Path) -> RegisteredCamera:
        camera = load_yaml(path, RegisteredCamera)
        if not (is_name(name) and is_name(camera.id)):
            raise ConfigError(f"{path}: its name and its id must have letters, digits, _, . and - only")
        twin = next((other for other, entry in self._cameras.items() if entry.id == camera.id), None)
        if twin is not None:
            raise ConfigError(f"{path} has the id of {twin}.yaml; delete one of them")
        return camera

    def _write(self, name: str, camera: RegisteredCamera) -> None:
        if self._folder is not None:
            try:
                self._folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(f"{self._folder} can't be created: {error.strerror}") from None
            path = self._folder / f"{name}.yaml"
            write_atomically(path, dump_yaml(_CameraFile.of(camera)))
            self._read_at[name] = path.stat().st_mtime_ns
        self._cameras[name] = camera

    def _remove(self, name: str) -> None:
        if self._folder is not None:
            (self._folder / f"{name}.yaml").unlink(missing_ok=True)
            self._read_at.pop(name, None)
        self._registered.pop(name, None)
        self._cameras.pop(name, None)


def merged(stored: Settings, wanted: Settings) -> Settings:
    """The stored settings, replaced by those of `wanted` that are not None."""
    given = {
        field: value for field in wanted.__struct_fields__ if (value := getattr(wanted, field)) is not None
    }
    return msgspec.structs.replace(stored, **given)


def _free_name(cameras: dict[str, RegisteredCamera]) -> str:
    return next(name for k in range(1, MAX_CAMERAS + 2) if (name := f"camera-{k}") not in cameras)


def _require_free(cameras: dict[str, RegisteredCamera], name: str) -> None:
    if name in cameras:
        camera = cameras[name]
        raise RequestError(
            f"another camera has the name {name}: {camera.driver} {camera.source}; rename that one, or forget it "
            f"with roundel cameras forget {name}"
        )
