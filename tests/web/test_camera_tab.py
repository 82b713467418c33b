# SPDX-License-Identifier: BSD-3-Clause
"""The tab Cameras in a real browser: live pictures on demand, and settings and mask of a camera."""

import time
from collections.abc import Iterator

import cv2
import msgspec
import numpy as np
import pytest
import zenoh

from camera_node.protocol.messages import Preview, Settings, decode, encode
from camera_node.protocol.registration import CameraChange, RegisteredCameras, change_key
from camera_node.protocol.requests import encode_jpeg
from tests.waiting import wait_for
from tests.web.arena import LiveArena
from tests.web.browser import browsing, set_checkbox, value_of
from web.view import View

ROUNDEL = (320.0, 240.0)


class SettingsOfEast:
    """Answers as the node of camera "east" does, and records the requests."""

    def __init__(self, arena: LiveArena, image: np.ndarray) -> None:
        self.used = Settings(exposure_us=4000.0, gain=2.0, min_contrast=25.0, mask=())
        self.changes: list[Settings] = []
        self._jpeg, keys = encode_jpeg(image, 90), arena.keys
        self.queryables = [
            arena.session.declare_queryable(keys.settings("east"), self._answer),
            arena.session.declare_queryable(keys.snapshot("east"), self._answer_snapshot),
        ]

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            if query.payload:
                self.changes.append(decode(query.payload.to_bytes(), Settings))
                given = {k: v for k, v in msgspec.structs.asdict(self.changes[-1]).items() if v is not None}
                self.used = msgspec.structs.replace(self.used, **given)
            query.reply(query.key_expr, encode(self.used))

    def _answer_snapshot(self, query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, self._jpeg)

    def close(self) -> None:
        for queryable in self.queryables:
            queryable.undeclare()


@pytest.fixture
def east(arena: LiveArena) -> Iterator[SettingsOfEast]:
    node = SettingsOfEast(arena, np.full((480, 640), 90, np.uint8))
    yield node
    node.close()


def is_matched(publisher: zenoh.Publisher) -> bool:
    """Whether someone subscribes."""
    return publisher.matching_status.matching  # pyright: ignore[reportAttributeAccessIssue]


def test_pictures_and_settings_of_a_camera(arena: LiveArena, view: View, east: SettingsOfEast):
    """Pictures are subscribed to while a browser is open; a click on the mask sends polygons around the detections."""
    jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
    publisher = arena.session.declare_publisher(arena.keys.preview("east"))

    def speak() -> None:
        arena.camera("east")
        arena.detections("east", [ROUNDEL])
        preview = Preview(camera="east", t_ns=time.time_ns(), width=640, height=480, jpeg=jpeg)
        publisher.put(encode(preview))

    assert not is_matched(publisher), "no browser is open"
    with browsing(view) as page:
        wait_for(lambda: page.locator("img[alt=east]").count(), speak)
        caption = page.get_by_text("east: 640 x 480, 1 roundels")
        wait_for(caption.count, speak)
        size = "document.querySelector('img[alt=east]').naturalWidth"
        wait_for(lambda: page.evaluate(size) == 64, speak)
        exposure = page.locator("xpath=//*[text()='Exposure, us']/following::input[1]")
        wait_for(lambda: exposure.input_value() == "4000", speak)  # read when the camera is selected
        exposure.fill("3000")
        exposure.press("Enter")
        page.get_by_role("button", name="Apply").click()
        page.get_by_text("exposure 3000 us, 0 masked places").wait_for()
        undo = page.get_by_role("button", name="Undo the change of a camera")
        wait_for(undo.is_enabled, speak)
        undo.click()
        page.get_by_text("undone: exposure, gain and contrast of east").wait_for()
        assert east.used.exposure_us == 4000.0
        page.get_by_role("button", name="Read the settings").click()
        page.get_by_text("exposure 4000 us, 0 masked places").wait_for()
        page.get_by_role("button", name="Mask everything detected now").click()
        page.get_by_text("east: 1 masked places").wait_for()
        page.get_by_role("button", name="Remove the mask").click()
        page.get_by_text("east: 0 masked places").wait_for()
        set_checkbox(page, view, "Show what the cameras see")
        set_checkbox(page, view, "Live pictures", False)
        wait_for(lambda: not page.locator("img[alt=east]").count(), speak)
        wait_for(lambda: not is_matched(publisher))
    assert east.changes[0].exposure_us == 3000.0
    polygon = np.array(east.changes[2].mask)[0]
    assert cv2.pointPolygonTest(polygon.astype(np.float32), ROUNDEL, False) > 0
    assert east.changes[3].mask == ()
    wait_for(lambda: not is_matched(publisher))
    publisher.undeclare()


def test_a_mask_is_drawn_by_clicks(arena: LiveArena, view: View, east: SettingsOfEast):
    """Two clicks make a rectangle: the centre of the view is that of the picture, and v grows downwards."""
    with browsing(view) as page:
        draw = page.get_by_role("button", name="Draw on the picture")
        wait_for(draw.is_enabled, lambda: arena.camera("east"))
        (client,) = view.server.get_clients().values()
        draw.click()
        page.get_by_text("east, 0 masked places").wait_for()
        wait_for(lambda: client.camera.position[2] < -100)
        box = page.locator("canvas").first.bounding_box()
        assert box is not None
        middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.wait_for_function(
            "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        )
        page.mouse.click(*middle)
        page.get_by_text("corner 1 at 320, 240").or_(page.get_by_text("corner 1 at 319, 239")).wait_for()
        page.mouse.click(middle[0] + 60, middle[1] + 30)
        page.get_by_text("corner 2 at").wait_for()
        page.get_by_role("button", name="Remove the last corner").click()
        page.get_by_text("1 corners").wait_for()
        page.mouse.click(middle[0] + 60, middle[1] + 30)
        page.get_by_text("corner 2 at").wait_for()
        page.get_by_role("button", name="Add what is drawn to the mask").click()
        page.get_by_text("east: 1 masked places").wait_for()
        page.get_by_role("button", name="Back to the arena's view").click()
        wait_for(lambda: np.linalg.norm(client.camera.look_at) < 5.0)  # the arena's view
    (polygon,) = np.array(east.changes[0].mask)
    size = np.ptp(polygon, axis=0)
    assert np.allclose(polygon.min(axis=0), (319.5, 239.5), atol=1.0), (
        "the first click: a pixel of the screen"
    )
    assert size[0] / size[1] == pytest.approx(2.0, abs=0.1)
    assert size[0] > 30


def test_a_camera_is_renamed_and_forgotten(arena: LiveArena, view: View):
    """The server gets the requests; an empty name is refused."""
    changes: list[CameraChange] = []

    def answer(query: zenoh.Query) -> None:
        with query:
            assert query.payload is not None
            changes.append(decode(query.payload.to_bytes(), CameraChange))
            query.reply(query.key_expr, encode(RegisteredCameras(cameras={})))

    queryable = arena.session.declare_queryable(change_key("test"), answer)
    with browsing(view) as page:
        rename = page.get_by_role("button", name="Rename the camera")
        wait_for(rename.is_enabled, lambda: arena.camera("camera-1"))
        rename.click()
        page.get_by_text("'' can't name a camera").wait_for()
        page.locator("xpath=//*[text()='Rename to']/following::input[1]").fill("north-2")
        wait_for(lambda: value_of(view, "Rename to") == "north-2")
        rename.click()
        page.get_by_text("camera-1 is called north-2 from now on", exact=True).wait_for()
        page.get_by_role("button", name="Forget the camera").click()
        page.get_by_text("click again to forget camera-1").wait_for()
        page.get_by_role("button", name="Forget: click again").click()
        page.get_by_text("camera-1 is forgotten").wait_for()
    assert (changes[0].camera, changes[0].name) == ("camera-1", "north-2")
    assert (changes[-1].camera, changes[-1].forget) == ("camera-1", True)
    queryable.undeclare()
