# SPDX-License-Identifier: BSD-3-Clause
"""A synthetic arena whose cameras render images, in which the detector finds the roundels."""

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from calib.rig.camera import Camera
from camera_node.detection.detector import Detector
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert
from camera_node.simulation.discs import Disc, RollingDisc, discs_while_read, place_discs
from camera_node.simulation.floor import paint_floor
from camera_node.simulation.renderer import ImageModel
from camera_node.simulation.scene import SceneCamera
from tests.fusion.synthetic import Arena


class View:
    """One camera: its image model, background and detector."""

    def __init__(self, name: str, camera: Camera) -> None:
        lens: dict[str, Any] = {key: getattr(camera, key) for key in Lens.__struct_fields__}
        # The pose is not used: an image model has discs in the camera's frame.
        optics = SceneCamera(position_m=(0.0, 0.0, 1.0), look_at_m=(0.0, 0.1, 0.0), **lens)
        self.T_cam_world = invert(camera.matrix())
        self._model = ImageModel(optics, zlib.crc32(name.encode()))
        self._backdrop = self._model.view(paint_floor(1), camera.matrix())
        self._detector = Detector()

    def detect(self, discs: Sequence[Disc | RollingDisc], number: int) -> Roundels:
        """The roundels that the detector finds in the image of such a number, which seeds its noise."""
        image = self._backdrop.copy()
        for disc in sorted(discs, key=lambda disc: -disc.distance_m):
            if disc.faces_camera:
                self._model.paint(image, [disc])
        return self._detector.detect(self._model.expose(image, number))


@dataclass
class RenderedArena(Arena):
    """As `Arena`, but what a camera detects are the roundels that its detector finds in a rendered image.

    The images have blur and noise, and a floor with marks; a rolling shutter reads each of their rows at its own time.
    Frames can be taken once, in order of time, because detectors follow roundels.
    """

    views: dict[str, View] = field(init=False)

    def __post_init__(self) -> None:
        self.views = {name: View(name, camera) for name, camera in self.cameras.items()}

    def detect(self, name: str, t: float, rng: np.random.Generator) -> Roundels:
        """What a camera detects in a frame whose middle is read at t seconds."""
        view = self.views[name]
        discs = discs_while_read(lambda t_s: self._discs_at(t_s, view.T_cam_world), t, self.readout_s)
        return view.detect(list(discs.values()), int(rng.integers(1 << 30)))

    def _discs_at(self, t: float, T_cam_world: Array) -> Mapping[tuple[str, int], Disc]:
        """Every roundel, by robot and number."""
        discs = {}
        for name, robot in self.robots.items():
            T = np.eye(4)
            T[:3, :3], T[:3, 3] = self.motions[name](t)
            discs |= {(name, k): disc for k, disc in enumerate(place_discs(robot, T_cam_world @ T))}
        return discs
