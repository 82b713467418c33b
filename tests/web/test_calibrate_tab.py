# SPDX-License-Identifier: BSD-3-Clause
"""The tab Calibrate: the floor and the origin, and the history of the rig."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from calib.rig.messages import RigMessage
from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.config import dump_yaml
from camera_node.geometry.body import Body
from camera_node.geometry.pose import Pose
from camera_node.protocol.messages import encode
from camera_node.protocol.requests import RequestSource
from tests.calib.synthetic import ring
from tests.calib.world.landmarks import L_FRAME, detect_landmarks, in_another_world
from tests.waiting import repeating, wait_for
from tests.web.arena import LiveArena, four_cameras
from tests.web.browser import loopback
from web.errors import WebError
from web.feed import Feed
from web.scene.cameras import CameraDrawing
from web.subscription import Subscription
from web.tabs.calibrate import describe_change, tabulate_rigs
from web.tabs.rig_change import CalibrationFiles
from web.tabs.world import L_FRAME as BY_L_FRAME
from web.tabs.world import STANDING, WorldPanel
from web.view import View

ARENA = ring(3)


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
        for frame in frames:
            arena.put(arena.keys.detections(frame.camera), encode(frame))

    view = View(subscription.feed, loopback())
    panel = WorldPanel(view.server, subscription, files, collect_s=1.0)
    with pytest.raises(WebError, match="no measurement"):
        panel.accept()
    panel._by.value = BY_L_FRAME
    with repeating(send, 0.1):
        text = panel.measure()
    assert "accept or discard" in text
    assert panel._change is not None
    assert load_rig(files.rig) == rig, "nothing changes before the user accepts"
    origin = panel._change.origin_in(rig)
    true = rig.cameras["cam0"].matrix() @ np.linalg.inv(ARENA.truth.cameras["cam0"].matrix())
    assert origin == pytest.approx(true, abs=5e-3)
    panel.accept()
    for name, camera in load_rig(files.rig).cameras.items():
        assert camera.matrix() == pytest.approx(ARENA.truth.cameras[name].matrix(), abs=5e-3)
    panel._by.value = STANDING
    files.wand.write_text(dump_yaml(l_frame))
    with pytest.raises(WebError, match="not a straight wand"):
        panel.measure()
    assert panel._change is None
    view.close()


def moved(rig: Rig, name: str, metres: float) -> Rig:
    T = rig.cameras[name].matrix()
    T[0, 3] += metres
    camera = msgspec.structs.replace(rig.cameras[name], T_world_cam=Pose.from_matrix(T))
    return Rig(cameras={**rig.cameras, name: camera})


def test_the_history_names_what_changed(arena: LiveArena, subscription: Subscription):
    """Each rig once, newest first, with the program and the motion of its cameras."""
    rig, feed = four_cameras(), subscription.feed
    source = RequestSource(program="calib wand", host="lab", user="x")
    rigs = [rig, moved(rig, "north", 0.012)]
    messages = [
        RigMessage(t_ns=(k + 1) * 10**18, rig=r, source=source if k else None) for k, r in enumerate(rigs)
    ]
    for message in (*messages, messages[-1]):  # a query repeats the one in force
        arena.put(arena.keys.rig, encode(message))
    wait_for(lambda: feed.state().message_counts["RigMessage"] == 3)
    rows = tabulate_rigs(feed.state().rigs).rows
    assert [row.cells[1:] for row in rows] == [
        ("calib wand", "north 12.0 mm"),
        ("the server", "4 cameras placed"),
    ]
    assert [row.level for row in rows] == ["ok", "wait"]


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


def test_changes_of_a_rig():
    rig = four_cameras()
    three = Rig(cameras={name: camera for name, camera in rig.cameras.items() if name != "west"})
    assert describe_change(rig, rig) == "the same poses"
    assert describe_change(rig, three) == "west not placed"
    assert describe_change(three, rig) == "west placed"
    everything = in_another_world(rig)
    assert describe_change(rig, everything).endswith("1 more")
