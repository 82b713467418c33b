# SPDX-License-Identifier: BSD-3-Clause
"""A wave that is begun, followed and ended in a real browser places cameras."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
import zenoh

from calib.rig.recording import read_detections, save_wand_recording
from calib.rig.rig import load_rig, save_rig
from camera_node.config import dump_yaml
from camera_node.errors import ConfigError
from camera_node.protocol.messages import encode
from camera_node.protocol.session import open_client
from tests.calib.synthetic import assert_near, record, ring
from tests.conftest import free_port
from tests.web.conftest import Played, wait_for
from tests.web.test_view import browsing, drawing
from web.calibrating import Calibrating, Files, describe, place_cameras
from web.errors import WebError
from web.subscription import Subscription
from web.view import View

ARENA = ring(3)
SOLVED_MS = 120_000  # a busy machine starts two processes and places cameras


@pytest.fixture
def files(tmp_path: Path) -> Files:
    """Lenses without places, and the wand."""
    save_rig(ARENA.intrinsics, tmp_path / "rig.yaml")
    (tmp_path / "wand.yaml").write_text(dump_yaml(ARENA.wand))
    return Files(tmp_path / "rig.yaml", tmp_path / "wand.yaml")


@pytest.fixture
def view(subscription: Subscription, files: Files) -> Iterator[View]:
    """A view that draws, with the button."""
    view = View(subscription.feed, port=free_port())
    with drawing(view), closing(Calibrating(view.server, subscription, files)):
        yield view


def test_a_wave_in_the_page_places_the_cameras(played: Played, view: View, files: Files):
    """The rig is written, the wave is kept, the view draws the cameras, and the person who waved is told the grade."""
    sent = record(ARENA, 8.0)  # no noise
    with browsing(view) as page, open_client([played.endpoint]) as session:
        page.get_by_role("button", name="Wave the wand").click()
        page.get_by_text("waiting for cameras").wait_for(timeout=20_000)
        for message in sent:
            key = played.keys.detections(message.camera)
            session.put(key, encode(message), congestion_control=zenoh.CongestionControl.BLOCK)
        for name in ARENA.truth.cameras:
            page.get_by_text(name).first.wait_for(timeout=20_000)
        wait_for(lambda: sum(known.share for known in view.feed.latest().coverage.values()))
        page.get_by_role("button", name="End the wave").click()
        page.get_by_text("; no server is there to take it").wait_for(timeout=SOLVED_MS)
        page.get_by_text("grade").first.wait_for(timeout=20_000)
        page.get_by_role("button", name="Wave the wand").wait_for(timeout=20_000)
    kept = {(m.camera, m.t_ns) for m in read_detections(files.rig.with_name("rig.wave.mcap"))}
    assert kept <= {(m.camera, m.t_ns) for m in sent}
    assert len(kept) > len(sent) / 2
    found = load_rig(files.rig)
    assert_near(found, ARENA.truth, 1e-3, 1e-3)
    wait_for(lambda: (rig := view.feed.latest().rig) and rig.cameras == found.cameras)


def test_what_goes_wrong_with_a_wave_is_said_and_the_wave_is_kept(tmp_path: Path, files: Files):
    wave = tmp_path / "rig.wave.mcap"
    save_wand_recording(wave, "test", record(ARENA, 2.0))
    (tmp_path / "wand.yaml").write_text("{diameter_m: 0.12, markers: [[0, 0, 0], [0.25, 0, 0], [0.5, 0, 0]]}")
    before = files.rig.read_bytes()
    with pytest.raises(WebError, match=r"symmetric.*; the wave is kept as .*rig\.wave\.mcap"):
        place_cameras(wave, files)
    assert files.rig.read_bytes() == before


def test_files_that_are_not_there_are_said_before_a_page_is_shown(files: Files):
    files.check()
    files.wand.unlink()
    with pytest.raises(ConfigError, match=r"wand\.yaml does not exist"):
        files.check()


def test_a_clock_that_jumped_is_told():
    """As `calib wand` writes it; the rest is as it is for any rig."""
    told = describe(
        {"because": "grade D", "clock_jump": {"north": {"ms": -19.93, "sigma": 0.1, "at_s": 19.8}}}
    )
    assert told.startswith("grade D; the clock of north jumped by -20 ms")
    assert describe({}) == "the cameras are placed"
