# SPDX-License-Identifier: BSD-3-Clause
"""The floor, the world's axes and the light."""

import viser

from camera_node.foundation.arrays import Array
from camera_node.geometry.pose import wxyz_from_rotation
from web.colours import PREVIEW

AXES_M = 0.5
LABEL_SCALE = 0.7


def add_lights(scene: viser.SceneApi) -> None:
    """Add a sun and ambient light; Viser's default lights wash out colours on a dark ground."""
    scene.configure_default_lights(enabled=False)
    scene.configure_environment_map(None)
    scene.add_light_ambient("/lights/sky", intensity=1.2)
    scene.add_light_directional("/lights/sun", intensity=1.6, position=(2.0, -3.0, 5.0))


def add_floor(scene: viser.SceneApi) -> None:
    """Add the plane z = 0 with lines every metre, and the axes x (red), y (green) and z (blue), half a metre long."""
    scene.add_grid(
        "/floor",
        width=12.0,
        height=12.0,
        cell_color=(46, 49, 56),
        section_color=(72, 77, 88),
        fade_distance=14.0,
        fade_strength=2.0,
        fade_from="origin",
        cell_size=0.5,
        section_size=1.0,
    )
    scene.add_frame("/origin", axes_length=AXES_M, axes_radius=0.006, origin_radius=0.015)
    for name, place in (("x", (AXES_M, 0, 0)), ("y", (0, AXES_M, 0)), ("z", (0, 0, AXES_M))):
        scene.add_label(f"/origin/{name}", name, position=place, font_screen_scale=LABEL_SCALE)
    for metres in (1, 2):
        for axis, place in (("x", (metres, 0, 0)), ("y", (0, metres, 0))):
            scene.add_label(
                f"/scale/{axis}{metres}", f"{metres} m", position=place, font_screen_scale=LABEL_SCALE
            )


class WorldPreview:
    """The axes and the floor of a world that is not in use yet; nothing before `draw`."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._handles: list[viser.SceneNodeHandle] = []

    def draw(self, T_world_new: Array | None) -> None:
        """Draw the world whose pose (4, 4) in the present world this is; None removes it."""
        for handle in self._handles:
            handle.remove()
        self._handles = []
        if T_world_new is None:
            return
        frame = self._scene.add_frame(
            "/new_world",
            wxyz=wxyz_from_rotation(T_world_new[:3, :3]),
            position=T_world_new[:3, 3],
            axes_length=2 * AXES_M,
            axes_radius=0.012,
            origin_radius=0.03,
        )
        grid = self._scene.add_grid(
            "/new_world/floor",
            width=4.0,
            height=4.0,
            cell_color=PREVIEW,
            section_color=PREVIEW,
            cell_size=1.0,
        )
        label = self._scene.add_label("/new_world/name", "new origin", font_screen_scale=LABEL_SCALE)
        self._handles = [label, grid, frame]
