# SPDX-License-Identifier: BSD-3-Clause
"""Messages by which a camera gets its name, and keeps its name and settings: requests to the server, and its answers.

A camera without a name sends `CameraRegistration` to `<arena>/cameras/register`, and receives a `CameraAssignment`.
`CameraChange`, to `<arena>/cameras/set`, renames a camera, stores settings, or forgets it; the camera then receives its
new `CameraAssignment` on `<arena>/cameras/assigned/<id>`. A query on `<arena>/cameras` returns `RegisteredCameras`.
"""

from typing import Annotated

import msgspec

from camera_node.foundation.config import is_name
from camera_node.protocol.messages import VERSION, MessageError, Settings
from camera_node.protocol.requests import RequestSource

MAX_BYTES = 1 << 16  # of a message about one camera
MAX_SIDE = 32768  # pixels
MAX_TIME_NS = 1 << 62
Short = Annotated[str, msgspec.Meta(max_length=64)]
Long = Annotated[str, msgspec.Meta(max_length=200)]


class CameraRegistration(msgspec.Struct, frozen=True, kw_only=True):
    """A camera that asks for its name and settings.

    Attributes:
        id: identifies the camera wherever and whenever it is started; has the form of a name.
        driver: such as `v4l2`, `folder`, `video` or `sim`.
        source: what the camera's machine opens, for people, such as `/dev/video0 on pi-3`.
        width, height: of the image, pixels; 0 where unknown before the first frame.
        name: the name under which it runs, or one from its source; used if the server does not know the camera and no
            other camera has it. Empty for none.
        first_t_ns: recordings only: the time of the first frame, by the recording's own clock.
    """

    MAX_BYTES = MAX_BYTES
    version: int = VERSION
    id: Short
    driver: Short = ""
    source: Long = ""
    width: int = 0
    height: int = 0
    name: Short = ""
    first_t_ns: int | None = None

    def check(self) -> None:
        """Raise MessageError for an id or a name that no camera can have, and for an impossible size or time."""
        if not is_name(self.id) or (self.name and not is_name(self.name)):
            raise MessageError("an id or a name that no camera can have")
        if not (0 <= self.width <= MAX_SIDE and 0 <= self.height <= MAX_SIDE):
            raise MessageError("an impossible image size")
        if self.first_t_ns is not None and not 0 <= self.first_t_ns < MAX_TIME_NS:
            raise MessageError("an impossible time of the first frame")


class CameraAssignment(msgspec.Struct, frozen=True, kw_only=True):
    """The name and the settings of a camera.

    Attributes:
        id: the camera's.
        name: in all its keys and in rig.yaml.
        settings: to apply; those that are None are the camera's own.
        t_ns: the server's time.
        recording_shift_ns: recordings only: added to the times of its frames, it gives the server's times at which
            they count as captured. It is the same for all recordings that start together.
    """

    MAX_BYTES = MAX_BYTES
    version: int = VERSION
    id: Short
    name: Short
    settings: Settings = Settings()
    t_ns: int = 0
    recording_shift_ns: int | None = None

    def check(self) -> None:
        """Raise MessageError for an id or a name that no camera can have, and for invalid settings."""
        if not (is_name(self.id) and is_name(self.name)):
            raise MessageError("an id or a name that no camera can have")
        self.settings.check()


class CameraChange(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A change of a registered camera.

    Attributes:
        camera: its name, or its id.
        name: its new name; empty to keep its name. The rig in force is changed with it.
        settings: to store for its next start and to apply if it runs; those that are None stay as they are.
        forget: remove the camera; it registers again when it is started again.
        source: who asks.
    """

    MAX_BYTES = MAX_BYTES
    version: int = VERSION
    camera: Short
    name: Short = ""
    settings: Settings = Settings()
    forget: bool = False
    source: RequestSource | None = None

    def check(self) -> None:
        """Raise MessageError for a name that no camera can have, and for invalid settings."""
        if not is_name(self.camera) or (self.name and not is_name(self.name)):
            raise MessageError("a name that no camera can have")
        self.settings.check()


class RegisteredCamera(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """What is stored of a camera; the same fields as in `cameras/<name>.yaml`."""

    id: Short
    driver: Short = ""
    source: Long = ""
    width: int = 0
    height: int = 0
    settings: Settings = Settings()


class RegisteredCameras(msgspec.Struct, frozen=True, kw_only=True):
    """All cameras that registered, by name, whether they run or not."""

    version: int = VERSION
    cameras: dict[str, RegisteredCamera] = {}


def registered_key(arena: str) -> str:
    """The key of queries for `RegisteredCameras`."""
    return f"{arena}/cameras"


def register_key(arena: str) -> str:
    """The key of `CameraRegistration`."""
    return f"{arena}/cameras/register"


def change_key(arena: str) -> str:
    """The key of `CameraChange`."""
    return f"{arena}/cameras/set"


def assigned_key(arena: str, id: str) -> str:
    """The key on which the server publishes a camera's new `CameraAssignment`."""
    return f"{arena}/cameras/assigned/{id}"
