# SPDX-License-Identifier: BSD-3-Clause
"""A lens is calibrated in a real browser with rendered images of a board, as the node of a camera sends them."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh

from calib.rig.rig import Rig, load_rig
from camera_node.protocol.requests import encode_jpeg
from tests.calib.boards import LENS, SPEC, board_poses, render
from tests.waiting import repeating
from tests.web.arena import LiveArena, four_cameras
from tests.web.browser import browsing, showing
from web.state.subscription import Subscription
from web.tabs.calibration_panels import CalibrationFiles
from web.tabs.camera_tab import CameraSettings
from web.tabs.lens_panel import describe_lens
from web.view import View

N_VIEWS = 12  # that differ


@pytest.fixture
def files(tmp_path: Path) -> CalibrationFiles:
    return CalibrationFiles(tmp_path / "rig.yaml", tmp_path / "wand.yaml")


@pytest.fixture
def shown(subscription: Subscription, files: CalibrationFiles) -> Iterator[tuple[View, CameraSettings]]:
    """A view with the settings of one camera."""
    make = lambda view: CameraSettings(view.server, subscription, files)  # noqa: E731
    with showing(subscription.feed, make) as shown:
        yield shown


def test_a_lens_is_calibrated_in_the_page(
    arena: LiveArena, shown: tuple[View, CameraSettings], files: CalibrationFiles
):
    """The true lens results, to five of its own standard deviations; the file changes when it is accepted, and not when
    it is discarded."""
    view, settings = shown
    images = itertools.cycle([encode_jpeg(render(*pose), 95) for pose in board_poses(0.6, N_VIEWS)])

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(query.key_expr, next(images))

    queryable = arena.session.declare_queryable(arena.keys.snapshot("east"), answer)
    with repeating(lambda: arena.camera("east"), 0.2), browsing(view) as page:
        page.locator("xpath=//*[text()='Board']/following::input[1]").fill(SPEC)
        page.get_by_text("no lens yet").wait_for()
        page.get_by_role("button", name="Calibrate the lens with a board").click()
        page.get_by_text(f"east: {N_VIEWS} views of").wait_for()
        page.get_by_role("button", name="End, and calibrate").click()
        page.get_by_text("accept or discard it").wait_for()
        panel = settings._lens
        assert panel is not None
        candidate = panel.decision.result
        page.get_by_role("button", name="Discard the lens").click()
        page.get_by_text("discarded").wait_for()
        assert not files.rig.exists(), "nothing changes before the user accepts"
        panel.decision.result = candidate
        page.get_by_role("button", name="Accept the lens").click()
        page.get_by_text("its pose is void").wait_for()
    queryable.undeclare()
    lens = load_rig(files.rig).cameras["east"]
    assert lens.lens_sigma is not None
    error = np.subtract(lens.parameters, LENS.parameters)[:4]
    assert (np.abs(error) < 5 * np.array(lens.lens_sigma[:4])).all()


def test_the_state_of_a_lens():
    """Unknown, from a file, and calibrated with a board, also where the network sends anything in its place."""
    rig = four_cameras()
    assert describe_lens(None, "north").startswith("no lens yet")
    assert describe_lens(rig, "attic").startswith("no lens yet")
    assert describe_lens(rig, "north").endswith("59 degrees wide; not calibrated with a board")
    entry = {"date": "2026-11-22T10:00:00", "residual_px": 0.123}
    known = Rig(cameras=rig.cameras, calibration={"lenses": {"north": entry}})
    assert describe_lens(known, "north").endswith("with a board on 2026-11-22, residual 0.12 px")
    for odd in (
        {"lenses": 3},
        {"lenses": {"north": []}},
        {"lenses": {"north": {"date": [], "residual_px": "x"}}},
    ):
        assert "pinhole" in describe_lens(Rig(cameras=rig.cameras, calibration=odd), "north")
