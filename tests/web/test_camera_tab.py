# SPDX-License-Identifier: BSD-3-Clause
"""The tab Cameras in a real browser: live pictures on demand, and settings and mask of a camera."""

import time

import cv2
import msgspec
import numpy as np
import zenoh

from camera_node.protocol.messages import Preview, Settings, decode, encode
from tests.waiting import wait_for
from tests.web.arena import LiveArena
from tests.web.browser import browsing
from web.view import View

ROUNDEL = (320.0, 240.0)


def is_matched(publisher: zenoh.Publisher) -> bool:
    """Whether someone subscribes."""
    return publisher.matching_status.matching  # pyright: ignore[reportAttributeAccessIssue]


def test_pictures_and_settings_of_a_camera(arena: LiveArena, view: View):
    """Pictures are subscribed to while a browser is open; a click on the mask sends polygons around the detections."""
    jpeg = cv2.imencode(".jpg", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
    publisher = arena.session.declare_publisher(arena.keys.preview("east"))
    used, changes = Settings(exposure_us=4000.0, gain=2.0, min_contrast=25.0, mask=()), []

    def answer(query) -> None:
        nonlocal used
        with query:
            if query.payload:
                changes.append(decode(query.payload.to_bytes(), Settings))
                given = {k: v for k, v in msgspec.structs.asdict(changes[-1]).items() if v is not None}
                used = msgspec.structs.replace(used, **given)
            query.reply(query.key_expr, encode(used))

    queryable = arena.session.declare_queryable(arena.keys.settings("east"), answer)

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
        page.get_by_role("button", name="Read the settings").click()
        page.get_by_text("exposure 4000 us, 0 masked places").wait_for(timeout=20_000)
        page.get_by_role("button", name="Mask everything detected now").click()
        page.get_by_text("exposure 4000 us, 1 masked places").wait_for(timeout=20_000)
        page.get_by_role("button", name="Remove the mask").click()
        page.get_by_text("exposure 4000 us, 0 masked places").wait_for(timeout=20_000)
    polygon = np.array(changes[0].mask)[0]
    assert cv2.pointPolygonTest(polygon.astype(np.float32), ROUNDEL, False) > 0
    assert changes[1].mask == ()
    wait_for(lambda: not is_matched(publisher))
    for entity in (queryable, publisher):
        entity.undeclare()
