# SPDX-License-Identifier: BSD-3-Clause
"""The tab Calibrate: the floor and the origin, and the history of the rig."""

from contextlib import closing
from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.foundation.config import dump_yaml
from camera_node.geometry.body import Body
from camera_node.geometry.pose import Pose
from camera_node.protocol.messages import encode
from camera_node.protocol.server_connection import ServerConnection
from fusion.server.arena_config import ArenaConfig
from tests.calib.synthetic import ring
from tests.calib.world.landmarks import L_FRAME, detect_landmarks, in_another_world
from tests.fusion.serving import serving
from tests.waiting import repeating
from tests.web.arena import LiveArena, four_cameras
from tests.web.browser import browsing, loopback, showing
from web.errors import WebError
from web.scene.camera_frustums import CameraDrawing
from web.state.feed import Feed
from web.state.subscription import Subscription
from web.tabs.calibration_panels import CalibrationFiles, RigHistoryPanel, apply_rig
from web.tabs.world_panel import L_FRAME as BY_L_FRAME
from web.tabs.world_panel import STANDING, WorldPanel
from web.view import View

ARENA = ring(3)


@pytest.mark.ci
def test_the_world_is_measured_shown_and_accepted(
    arena: LiveArena, subscription: Subscription, tmp_path: Path
):
    """Of an L-frame on the floor: the true world results when it is accepted, and nothing changes before that."""
    files = CalibrationFiles(tmp_path / "rig.yaml", tmp_path / "wand.yaml")
    rig = in_another_world(ARENA.truth)
    save_rig(rig, files.rig)
    files.wand.write_text(dump_yaml(ARENA.wand))
    l_frame = Body(diameter_m=0.1, markers=tuple((x, y, z) for x, y, z in L_FRAME.values()))
    (tmp_path / "l.yaml").write_text(dump_yaml(l_frame))
    frames = detect_landmarks(ARENA, L_FRAME)

    def send() -> None:
        for name in rig.cameras:
            arena.camera(name)
        arena.rig(rig)
        for frame in frames:
            arena.put(arena.keys.detections(frame.camera), encode(frame))

    make = lambda view: WorldPanel(view.server, subscription, files, collect_s=1.0)  # noqa: E731
    with showing(subscription.feed, make) as (view, panel):
        with pytest.raises(WebError, match="nothing to accept"):
            panel.decision.accept()
        panel._by.here.value = BY_L_FRAME
        with repeating(send, 0.1), browsing(view) as page:
            page.get_by_text("Floor and origin").click()
            for decision in ("Discard", "Accept"):
                page.get_by_role("button", name="Measure").click()
                page.get_by_text("accept or discard them").wait_for()
                assert load_rig(files.rig) == rig, "nothing changes before the user accepts"
                assert panel.decision.result is not None
                origin = panel.decision.result.origin_in(rig)
                page.get_by_role("button", name=f"{decision} the new world").click()
                page.get_by_text("discarded" if decision == "Discard" else "the new world is").wait_for()
        true = rig.cameras["cam0"].matrix() @ np.linalg.inv(ARENA.truth.cameras["cam0"].matrix())
        assert origin == pytest.approx(true, abs=5e-3)
        panel._by.here.value = STANDING
        files.wand.write_text(dump_yaml(l_frame))
        with pytest.raises(WebError, match="not a straight wand"):
            panel.measure()
        assert panel.decision.result is None
    for name, camera in load_rig(files.rig).cameras.items():
        assert camera.matrix() == pytest.approx(ARENA.truth.cameras[name].matrix(), abs=5e-3)


def moved(rig: Rig, name: str, metres: float) -> Rig:
    T = rig.cameras[name].matrix()
    T[0, 3] += metres
    camera = msgspec.structs.replace(rig.cameras[name], T_world_cam=Pose.from_matrix(T))
    return Rig(cameras={**rig.cameras, name: camera})


def test_the_history_is_listed_undone_and_redone(tmp_path: Path):
    """By clicks, on a real server. The page writes the file in which the server saves its rig, as in `roundel up`, and
    each change is one step."""
    rig = four_cameras()
    files = CalibrationFiles(tmp_path / "rig.yaml", tmp_path / "wand.yaml")
    save_rig(rig, files.rig)
    settings = ArenaConfig(
        arena="test", listen=("tcp/127.0.0.1:0",), saved_rig=str(files.rig), robots=str(tmp_path / "no.yaml")
    )
    settings = msgspec.structs.replace(settings, saved_robots=settings.robots)
    with serving(settings) as (server, client), closing(ServerConnection(server.endpoints)) as connection:
        subscription = Subscription(connection, Feed("test"))
        make = lambda view: RigHistoryPanel(view.server.gui, subscription)  # noqa: E731
        with showing(subscription.feed, make) as (view, _), browsing(view) as page:
            for metres in (0.012, 0.034):
                apply_rig(subscription, files, moved(rig, "north", metres))
            for change in ("north 12.0 mm", "north 22.0 mm"):
                page.get_by_text(change, exact=True).wait_for()
            assert page.get_by_role("button", name="Undo the last change: north 22.0 mm").is_enabled()
            assert page.get_by_role("button", name="Redo").is_disabled()
            page.get_by_role("button", name="Undo the last change").click()
            page.get_by_role("cell", name="undone", exact=True).wait_for()
            assert load_rig(files.rig) == moved(rig, "north", 0.012)
            page.get_by_role("button", name="Redo").click()
            page.get_by_role("cell", name="undone", exact=True).wait_for(state="detached")
        assert load_rig(files.rig) == moved(rig, "north", 0.034)
        assert [version.state for version in client.rig_history().versions] == ["earlier"] * 2 + ["in force"]
        subscription.close()


def test_only_what_changed_is_drawn_again():
    """A camera that moved keeps its node, which would lose its label otherwise; a removed one disappears."""
    view, rig = View(Feed("test"), loopback()), four_cameras()
    drawing = CameraDrawing(view.server.scene)
    drawing.draw(rig)
    before = dict(drawing._frustums)
    drawing.draw(moved(rig, "north", 0.5))
    assert drawing._frustums == before
    assert before["north"].position[0] == pytest.approx(rig.cameras["north"].matrix()[0, 3] + 0.5)
    drawing.draw(Rig(cameras={"north": rig.cameras["north"]}))
    assert drawing._frustums == {"north": before["north"]}
    drawing.draw(None)
    assert not drawing._frustums
    view.close()
