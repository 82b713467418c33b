# SPDX-License-Identifier: BSD-3-Clause
"""Moves the world of a rig to stationary roundels at known places: an L-shaped frame, a standing wand, or a survey."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from calib.rig.rig import Rig
from calib.world.landmarks import locate_landmarks
from calib.world.still_roundels import find_still_roundels
from calib.world.world_frame import align_positions, align_standing_wand, check_above
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from camera_node.geometry.pose import invert
from camera_node.protocol.messages import Detections


@dataclass(frozen=True)
class WorldChange:
    """A rig in its new world.

    Attributes:
        rig: the moved rig.
        distances: of roundels or cameras from their surveyed positions, metres, by name.
        missing: names of the roundels that fewer than two cameras see, which were not used.
    """

    rig: Rig
    distances: dict[str, float] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)

    def origin_in(self, before: Rig) -> Array:
        """T_old_new (4, 4): the new origin and axes in the world of the rig before the change, of the same scale."""
        new = self.rig.placed()
        name = next(iter(before.placed().keys() & new.keys()))
        return before.cameras[name].matrix() @ invert(new[name].matrix())


def name_markers(body: Body) -> dict[str, Array]:
    """The markers of a body as landmarks: their numbers and positions (3,), metres."""
    return {str(k): point for k, point in enumerate(body.points)}


def align_to_roundels(
    rig: Rig, landmarks: Mapping[str, Array], messages: Sequence[Detections], foot_m: float | None = None
) -> WorldChange:
    """Move the world to stationary roundels.

    Args:
        rig: with placed cameras.
        landmarks: positions (3,) of the roundels in the new world, metres, by name.
        messages: detections of the cameras while the roundels stand still.
        foot_m: for a wand that stands upright: the height of its lowest roundel above the floor; None for roundels
            whose positions fix the world.

    Raises:
        CalibrationError: the roundels are not found, or do not fix a world.
    """
    located = locate_landmarks(rig.placed(), find_still_roundels(messages), landmarks)
    missing = [name for name in landmarks if name not in located]
    if foot_m is not None:
        moved = align_standing_wand(rig, np.array(list(located.values())), foot_m)
        return WorldChange(moved, missing=missing)
    moved, distances = align_positions(rig, located, landmarks, "roundel")
    check_above(moved, landmarks)
    return WorldChange(moved, distances, missing)
