# SPDX-License-Identifier: BSD-3-Clause
"""The tab Cameras: what each camera does and sees."""

import threading
from collections.abc import Callable
from contextlib import suppress
from contextvars import copy_context
from functools import partial
from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from camera_node.foundation.config import require_name
from camera_node.foundation.errors import NetworkError, RoundelError
from camera_node.protocol.camera_requests import change_camera
from camera_node.protocol.messages import Preview, Settings
from camera_node.protocol.registration import CameraChange
from camera_node.protocol.requests import RequestSource
from camera_node.protocol.session import guarded
from web.errors import WebError
from web.html_tables import draw_cells, picture, picture_grid
from web.own_control import OwnControl, each_browser
from web.scene.camera_frustums import CameraDrawing
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.tables import STALE_S, tabulate_cameras
from web.tabs.calibration_panels import CalibrationFiles
from web.tabs.lens_panel import LensPanel
from web.tabs.mask_editor import MaskEditor
from web.widgets import ActionButton, Answer, ConfirmedButton, UndoButton, inside, set_content, set_property

NO_CAMERA = "no camera yet"
FIELDS: tuple[Callable[[viser.GuiApi], Any], ...] = (  # name, exposure, gain, contrast
    lambda gui: gui.add_text("Rename to", "", hint="in the rig, in files and on the network"),
    lambda gui: gui.add_number("Exposure, us", 0.0, min=0.0, max=1e6, step=1.0),
    lambda gui: gui.add_number("Gain", 0.0, min=0.0, max=1e6, step=0.1, hint="in the driver's units"),
    lambda gui: gui.add_number(
        "Contrast", 25.0, min=5.0, max=250.0, step=1.0, hint="least contrast of a roundel, grey levels"
    ),
)
RETURNS = "; a camera that still runs registers again when it is restarted"


class CameraTable:
    """One row for each camera, and until the cameras are calibrated, where each has seen roundels."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._table = gui.add_html("")
        self._coverage_folder = gui.add_folder("Wand coverage", visible=False)
        with self._coverage_folder:
            self._coverage = gui.add_html("")

    def update(self, state: ArenaState) -> None:
        """Show the state."""
        set_content(self._table, tabulate_cameras(state).html())
        calibrated = state.rig is not None and bool(state.rig.placed())
        set_property(self._coverage_folder, "visible", bool(state.coverage) and not calibrated)
        if self._coverage_folder.visible:
            pictures = (
                (draw_cells(coverage, f"where {name} saw roundels"), f"{name}: {coverage.share():.0%}")
                for name, coverage in sorted(state.coverage.items())
            )
            set_content(self._coverage, picture_grid(pictures))


class LivePictures:
    """The cameras' pictures in a grid and in their frustums, while a browser is open and the box is ticked."""

    def __init__(
        self, server: viser.ViserServer, subscription: Subscription, frustums: CameraDrawing
    ) -> None:
        self._server, self._subscription, self._frustums = server, subscription, frustums
        self._wanted = server.gui.add_checkbox(
            "Live pictures", True, hint="each camera sends a small picture about three times a second"
        )
        self._grid = server.gui.add_html("")
        self._is_watched = False

    def update(self, state: ArenaState) -> None:
        """Show the recent pictures; those of a silent camera disappear."""
        is_watched = self._wanted.value and bool(self._server.get_clients())
        if is_watched != self._is_watched:
            self._is_watched = is_watched
            self._subscription.watch_previews(is_watched)
        recent = {
            name: timed.message
            for name, timed in sorted(state.previews.items())
            if is_watched and state.age_s(timed) < STALE_S
        }
        set_content(self._grid, picture_grid(_describe(preview, state) for preview in recent.values()))
        for name in state.previews:
            self._frustums.show_picture(name, recent[name].jpeg if name in recent else None)

    def close(self) -> None:
        """Have the cameras send no pictures."""
        self._subscription.watch_previews(False)


def _describe(preview: Preview, state: ArenaState) -> tuple[str, str]:
    """A camera's picture for `picture_grid`, with the number of its roundels."""
    name = preview.camera
    seen = len(state.detections[name]) if name in state.detections else 0
    return picture(name, preview.jpeg), f"{name}: {preview.width} x {preview.height}, {seen} roundels"


class CameraSettings:
    """The name and the settings of one camera, its mask, its lens, and its image in full resolution."""

    def __init__(
        self,
        server: viser.ViserServer,
        subscription: Subscription,
        files: CalibrationFiles | None = None,
    ) -> None:
        gui = server.gui
        self._server, self._subscription = server, subscription
        self._shown: dict[int, str] = {}  # by browser: the camera whose settings are in its fields
        self._folder = place = gui.add_folder("One camera")
        with place:
            self._camera = OwnControl(server, place, lambda gui: gui.add_dropdown("Camera", [NO_CAMERA]))
            self._new_name, self._exposure, self._gain, self._contrast = (
                OwnControl(server, place, add) for add in FIELDS
            )
            answer = Answer(gui)
            self._forget = ConfirmedButton(
                gui,
                "Forget the camera",
                lambda: self._name,
                self.forget,
                answer,
                RETURNS,
                "of a camera that was removed",
            )
            self._buttons = (
                ActionButton(gui, "Rename the camera", self.rename, answer),
                ActionButton(gui, "Read the settings", self.read, answer),
                ActionButton(gui, "Apply", self.apply, answer, "zero leaves exposure or gain as it is"),
                ActionButton(gui, "Take a snapshot", self._show_snapshot, answer),
            )
            self._image: viser.GuiImageHandle | None = None
            self._undo = UndoButton(gui, "Undo the change of a camera", answer)
            self._mask = MaskEditor(
                server, subscription, lambda: self._name, self._request_picture, self.change_settings
            )
            self._lens = LensPanel(server, subscription, files, lambda: self._name) if files else None

    def update(self, state: ArenaState) -> None:
        """Offer the cameras that publish."""
        of_server = state.status.message.cameras if state.status else {}
        names = tuple(sorted({*state.cameras, *of_server}))
        self._camera.offer(names, NO_CAMERA)
        for button in self._buttons:
            button.show(enabled=bool(state.cameras))
        self._undo.update()
        self._forget.show(enabled=bool(names))
        show = guarded("the settings of a camera", self._show_present)
        for client in each_browser(self._server):
            name = str(self._camera.here.value)
            if name in state.cameras and name != self._shown.get(client.client_id):
                self._shown[client.client_id] = name
                run = copy_context().run
                threading.Thread(target=run, args=[show, name], name="settings", daemon=True).start()
        self._mask.update(state)
        if self._lens is not None:
            self._lens.update(state)

    def close(self) -> None:
        """End a capture of a board."""
        if self._lens is not None:
            self._lens.close()

    def rename(self) -> str:
        """Have the server rename the camera, in the rig too. Raises ConfigError, RequestError or NetworkError."""
        old, new = self._name, str(self._new_name.here.value).strip()
        require_name(new, "a camera")
        self._change(CameraChange(camera=old, name=new, source=RequestSource.of("web")))
        self._new_name.here.value = ""
        back = CameraChange(camera=new, name=old, source=RequestSource.of("web"))
        return self._undo.note(f"{old} is called {new} from now on", lambda: self._change(back))

    def change_settings(self, name: str, wanted: Settings, about: str) -> Settings:
        """Change settings of a camera so that they can be undone; returns those in use, raises as `Subscription`."""
        before = self._subscription.change_settings(name)
        after = self._subscription.change_settings(name, wanted)
        self._undo.note(f"{about} of {name}", partial(self._restore, name, before, after))
        return after

    def _restore(self, name: str, before: Settings, after: Settings) -> None:
        if self._subscription.change_settings(name) != after:
            raise WebError(f"{name} was changed since, by another program or page: nothing is undone")
        if self._subscription.change_settings(name, before) != before:
            raise WebError(
                f"{name} can't return to an automatic exposure or gain from here; the rest is undone"
            )

    def forget(self) -> str:
        """Have the server forget the camera. Raises RequestError or NetworkError."""
        name = self._name
        self._change(CameraChange(camera=name, forget=True, source=RequestSource.of("web")))
        return f"{name} is forgotten"

    def _change(self, change: CameraChange) -> None:
        arena = self._subscription.feed.keys.arena
        change_camera(self._subscription.session, arena, change)

    def _show_present(self, name: str) -> None:
        """Fill the fields with the settings of a camera that was selected."""
        with suppress(RoundelError):  # the button shows why it does not answer
            used = self._subscription.change_settings(name)
            if name == self._camera.here.value:
                self._show(used)

    def read(self) -> str:
        """Show the settings in use."""
        return self._show(self._subscription.change_settings(self._name))

    def apply(self) -> str:
        """Change exposure, gain and contrast."""
        wanted = Settings(
            exposure_us=self._exposure.here.value or None,
            gain=self._gain.here.value or None,
            min_contrast=self._contrast.here.value,
        )
        return self._show(self.change_settings(self._name, wanted, "exposure, gain and contrast"))

    @property
    def _name(self) -> str:
        return self._camera.chosen

    def _show(self, used: Settings) -> str:
        contrast = self._contrast.here
        self._exposure.here.value, self._gain.here.value = used.exposure_us or 0.0, used.gain or 0.0
        contrast.value = used.min_contrast or contrast.value
        exposure = "automatic" if used.exposure_us is None else f"{used.exposure_us:.0f} us"
        return f"{self._name}: exposure {exposure}, {len(used.mask or ())} masked places"

    def _show_snapshot(self) -> str:
        name = self._name
        image = self._request_picture(name)
        if self._image is not None:
            self._image.remove()
        with inside(self._folder):
            self._image = self._server.gui.add_image(image, format="jpeg")
        return f"{name}, {image.shape[1]} x {image.shape[0]}"

    def _request_picture(self, name: str) -> NDArray[np.uint8]:
        """The current image of a camera, (h, w, 3) RGB; raises as `request_snapshot`."""
        image = decode_jpeg(self._subscription.snapshot(name))
        if image is None:
            raise NetworkError(f"{name} sent no JPEG image; is it of this version of Roundel?")
        return image


def decode_jpeg(data: bytes) -> NDArray[np.uint8] | None:
    """Decode a JPEG to (h, w, 3) RGB; return None for anything else."""
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if image is None else np.ascontiguousarray(image[..., ::-1], np.uint8)
