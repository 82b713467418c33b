# SPDX-License-Identifier: BSD-3-Clause
"""A wand session that is started and ended in a real browser calibrates the cameras."""

import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh

from calib.rig.recording import read_detections, save_wand_recording
from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.foundation.config import dump_yaml
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import Pose
from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from tests.calib.synthetic import assert_near, record, ring
from tests.waiting import repeating, wait_for
from tests.web.arena import LiveArena
from tests.web.browser import browsing, loopback, showing
from web.errors import WebError
from web.state.subscription import Subscription
from web.tabs.calibration_panels import CalibrationFiles
from web.tabs.wand_session import (
    WandSessionPanel,
    calibrate_cameras,
    describe_calibration,
    describe_move,
    recalibrate_one,
)
from web.view import View

ARENA = ring(3)
SHIFT = np.zeros((4, 4))
SHIFT[:3, 3] = 0.06, 0.08, 0.0  # metres
CALIBRATION_MS = 120_000  # on a busy machine: two processes start, and one calibrates


@pytest.fixture
def files(tmp_path: Path) -> CalibrationFiles:
    """A rig without extrinsics, and the wand."""
    save_rig(ARENA.intrinsics, tmp_path / "rig.yaml")
    (tmp_path / "wand.yaml").write_text(dump_yaml(ARENA.wand))
    return CalibrationFiles(tmp_path / "rig.yaml", tmp_path / "wand.yaml")


@pytest.fixture
def shown(subscription: Subscription, files: CalibrationFiles) -> Iterator[tuple[View, WandSessionPanel]]:
    """A view with the panel."""
    make = lambda view: WandSessionPanel(view.server, subscription, files)  # noqa: E731
    with showing(subscription.feed, make) as shown:
        yield shown


@contextmanager
def cameras_present(arena: LiveArena) -> Iterator[None]:
    """Send the status of all cameras ten times a second."""

    def send() -> None:
        for name in ARENA.truth.cameras:
            arena.camera(name)

    with repeating(send, 0.1):
        yield


def test_a_wand_session_in_the_page_calibrates_the_cameras(
    arena: LiveArena, shown: tuple[View, WandSessionPanel], files: CalibrationFiles
):
    """The rig and the recording are written; the page shows the grade, and that no server has the rig in force."""
    (view, panel), sent = shown, record(ARENA, 8.0)  # no noise
    with browsing(view) as page, open_client([arena.endpoint]) as session:
        with cameras_present(arena):  # without cameras the button is disabled
            page.get_by_role("button", name="Start wand session").click()
            page.get_by_text("waiting for cameras").wait_for()
        for message in sent:
            key = arena.keys.detections(message.camera)
            session.put(key, encode(message), congestion_control=zenoh.CongestionControl.BLOCK)
        for name in ARENA.truth.cameras:
            page.get_by_text(name).first.wait_for()
        wait_for(lambda: sum(coverage.share() for coverage in view.feed.state().coverage.values()))
        assert "wave where" in panel.next_action()
        page.get_by_role("button", name="End wand session").click()
        wait_for(lambda: "wait for its calibration" in panel.next_action())
        page.get_by_text("accept or discard").wait_for(timeout=CALIBRATION_MS)
        assert not load_rig(files.rig).placed(), "nothing changes before the user accepts"
        wait_for(lambda: "decide" in panel.next_action())
        page.get_by_role("button", name="Accept the calibration").click()
        page.get_by_text("but not in force: no server answers").wait_for(timeout=CALIBRATION_MS)
        page.get_by_text("grade").first.wait_for()
        page.get_by_role("button", name="Start wand session").wait_for()
        assert panel.next_action() == ""
    saved = {(m.camera, m.t_ns) for m in read_detections(files.rig.with_name("rig.wave.mcap"))}
    assert saved <= {(m.camera, m.t_ns) for m in sent}
    assert len(saved) > len(sent) / 2
    assert not files.candidate.exists()
    rig = load_rig(files.rig)
    assert_near(rig, ARENA.truth, 1e-3, 1e-3)


def test_a_failed_calibration_names_the_recording(tmp_path: Path, files: CalibrationFiles):
    """With the reason; the rig file does not change."""
    recording = tmp_path / "rig.wave.mcap"
    save_wand_recording(recording, "test", record(ARENA, 2.0))
    (tmp_path / "wand.yaml").write_text("{diameter_m: 0.12, markers: [[0, 0, 0], [0.25, 0, 0], [0.5, 0, 0]]}")
    before = files.rig.read_bytes()
    with pytest.raises(WebError, match=r"differs from its file.*rig\.wave\.mcap"):
        calibrate_cameras(recording, files)
    assert files.rig.read_bytes() == before


def test_one_camera_is_recalibrated(tmp_path: Path, files: CalibrationFiles):
    """A camera that was moved by 10 cm is placed where it is; the others stay, and the rig's file too."""
    recording = tmp_path / "rig.wave.mcap"
    save_wand_recording(recording, "test", record(ARENA, 6.0))
    moved = msgspec.structs.replace(
        ARENA.truth.cameras["cam0"],
        T_world_cam=Pose.from_matrix(ARENA.truth.cameras["cam0"].matrix() + SHIFT),
    )
    before = Rig(cameras={**ARENA.truth.cameras, "cam0": moved})
    recalibrate_one(recording, files, before, "cam0")
    after = load_rig(files.candidate)
    assert after.cameras["cam1"] == before.cameras["cam1"]
    assert np.abs(after.cameras["cam0"].matrix() - ARENA.truth.cameras["cam0"].matrix()).max() < 1e-3
    assert re.fullmatch(r"cam0 moved by (99|100|101)\.\d mm", describe_move(before, after, "cam0"))
    assert not load_rig(files.rig).placed()


def test_the_wand_is_drawn_during_a_session(subscription: Subscription, files: CalibrationFiles):
    """With its trail, which begins again with the next trial, whose world differs."""
    view = View(subscription.feed, loopback())
    frames = sorted(record(ARENA, 3.0, free_running=False), key=lambda message: message.t_ns)
    with closing(WandSessionPanel(view.server, subscription, files)) as panel:
        for message in frames:
            subscription.feed.receive(
                view.feed.keys.detections(), view.feed.keys.detections(message.camera), encode(message)
            )
            panel._draw(ARENA.truth, ARENA.wand, is_trial=True)
        assert panel._wand.n_places > 10
        panel._draw(Rig(cameras=dict(ARENA.truth.cameras)), ARENA.wand, is_trial=True)
        assert panel._wand.n_places <= 1
    view.close()


def test_a_discarded_calibration_changes_nothing(
    shown: tuple[View, WandSessionPanel], files: CalibrationFiles
):
    """The preview and the candidate's file disappear; there is nothing left to accept."""
    (view, panel), before = shown, files.rig.read_bytes()
    save_rig(ARENA.truth, files.candidate)
    panel.decision.result = load_rig(files.candidate)
    with browsing(view) as page:
        page.get_by_role("button", name="Discard the calibration").click()
        page.get_by_text("discarded; the recording is").wait_for()
    assert not files.candidate.exists()
    assert files.rig.read_bytes() == before
    with pytest.raises(WebError, match="nothing to accept"):
        panel.decision.accept()


def test_missing_files_are_found_before_the_page_opens(files: CalibrationFiles):
    files.check()
    files.wand.unlink()
    with pytest.raises(ConfigError, match=r"wand\.yaml"):
        files.check()


def test_a_clock_jump_is_reported():
    """In the form in which `calib wand` writes it; an empty calibration also has a text."""
    jump = {"north": {"ms": -19.93, "sigma": 0.1, "at_s": 19.8}}
    text = describe_calibration({"because": "grade D", "clock_jump": jump})
    assert text.startswith("grade D")
    assert "north jumped by -20 ms" in text
    assert describe_calibration({})
