# SPDX-License-Identifier: BSD-3-Clause
"""Options for a camera that locates roundels by itself, such as the camera of a robot."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from camera_node.foundation.errors import ConfigError

if TYPE_CHECKING:
    from camera_node.detection.relative_positions import DiscLocalizer


@dataclass(frozen=True)
class RelativeSettings:
    """With both, the node also publishes the positions of all roundels relative to the camera."""

    rig: Path | None = None
    """A rig.yaml with the intrinsics of the camera of this name: positions relative to the camera are published, too.
    Requires --diameter."""
    diameter: float | None = None
    """Outer diameter of the black discs, metres. Requires --rig."""

    def check(self) -> None:
        """Raise ConfigError unless both are given, or none."""
        if (self.rig is None) != (self.diameter is None):
            raise ConfigError("--rig and --diameter must be given together; give both or none")

    def localizer(self, name: str) -> "DiscLocalizer | None":
        """The localizer of the camera `name`; None without a rig.

        Raises:
            ConfigError: the rig is missing or invalid or has no such camera, or no roundel has the diameter.
        """
        self.check()
        if self.rig is None or self.diameter is None:
            return None
        from camera_node.detection.relative_positions import DiscLocalizer
        from camera_node.geometry.lens import load_lens

        return DiscLocalizer(load_lens(self.rig, name), self.diameter)
