# SPDX-License-Identifier: BSD-3-Clause
"""What a program needs of Roundel: robot poses, the detector, calibration and recordings.

    from roundel import Arena, Detector, Recording, Rig, Robots
    from roundel import calibrate_intrinsics, calibrate_wand, simulate, track

| name | use |
|---|---|
| `Arena` | subscribe to the poses of a running server, change its robots and its rig |
| `Detector` | find roundels in grey images |
| `Rig`, `Robots` | read and write `rig.yaml` and `robots.yaml` |
| `Recording` | read detections and poses of a recording |
| `calibrate_intrinsics`, `calibrate_wand` | calibrate lenses, then the poses and clocks of cameras |
| `track` | estimate the poses of robots in a recording |
| `simulate` | render the cameras of a simulated arena |

`pip install roundel` is enough for the first three rows, the others need `pip install 'roundel[server]'`.
Every error that a user can fix is a `RoundelError`, whose message says what is wrong, where, and what to do. A name is
imported when it is first used, so `import roundel` takes no time, and a computer with cameras needs no package of the
server.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calib.rig.rig import Rig
    from camera_node.detection.detector import Detector
    from camera_node.foundation.errors import RoundelError
    from fusion.client.arena import Arena
    from fusion.protocol.pose_messages import Robots
    from roundel.offline import calibrate_intrinsics, calibrate_wand, simulate, track
    from roundel.recorded import Recording

__all__ = [
    "Arena",
    "Detector",
    "Recording",
    "Rig",
    "Robots",
    "RoundelError",
    "calibrate_intrinsics",
    "calibrate_wand",
    "simulate",
    "track",
]

_MODULES = {
    "Arena": "fusion.client.arena",
    "Detector": "camera_node.detection.detector",
    "Recording": "roundel.recorded",
    "Rig": "calib.rig.rig",
    "Robots": "fusion.protocol.pose_messages",
    "RoundelError": "camera_node.foundation.errors",
    "calibrate_intrinsics": "roundel.offline",
    "calibrate_wand": "roundel.offline",
    "simulate": "roundel.offline",
    "track": "roundel.offline",
}
_SERVER_PACKAGES = (
    "gtsam",
    "mcap",
    "psutil",
    "scipy",
)  # of the extra `server`, those that the modules import


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module 'roundel' has no attribute '{name}'")
    try:
        value = getattr(import_module(_MODULES[name]), name)
    except ImportError as error:
        if (error.name or "").split(".")[0] not in _SERVER_PACKAGES:
            raise
        from camera_node.foundation.errors import ConfigError

        raise ConfigError(f"roundel.{name} needs {error.name}; pip install 'roundel[server]'") from None
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
