# SPDX-License-Identifier: BSD-3-Clause
"""The panel's tables, the status line, coverage pictures and trails."""

import time
from dataclasses import replace

import msgspec
import numpy as np

from calib.rig.coverage import cell_centres
from calib.rig.rig import Rig
from fusion.protocol.pose_messages import CameraHealth, Contradiction
from tests.messages import HEALTH, NODE, STATUS
from tests.waiting import wait_for
from tests.web.arena import LiveArena, four_cameras
from web.colours import css, robot_colour
from web.html_tables import TableRow, draw_cells, status_line
from web.scene.robot_drawing import LENGTH, Trails, fade
from web.state.feed import ArenaState, Feed, TimedMessage
from web.tables import (
    STALE_S,
    describe_arena,
    describe_server,
    format_sigma,
    tabulate_cameras,
    tabulate_robots,
)


def test_the_tables_show_what_was_sent(arena: LiveArena, feed: Feed):
    """Each figure is in its column, and the covariance is a standard deviation in millimetres."""
    arena.pose("rover", (0.5, -0.25, 0.125))
    arena.camera("north", advice="too dark")
    arena.status()
    wait_for(lambda: (x := feed.state()).poses and x.cameras and x.status)
    state = feed.state()
    robot = ("rover", "tracked", "+0.50 -0.25 +0.12", "+0", "0.50", "1.0", "3")
    assert tabulate_robots(state).rows == [TableRow(robot, "ok", dot=css(robot_colour("rover")))]
    camera = ("north", "30.0", "0.7", "8.0", "0.6", "0.08", "5.1", "0.02", "2 / 1")
    assert tabulate_cameras(state).rows == [TableRow(camera, "warn", "too dark")]


def test_an_unused_camera_has_a_note():
    """Offline, not calibrated, moved, or a duplicate name; else the advice of its node."""
    health = msgspec.structs.replace(HEALTH, excluded=True)
    own = msgspec.structs.replace(NODE, advice="too dark")

    def advice(health: CameraHealth, now: float = 0.0, rig: Rig | None = None) -> str:
        status = msgspec.structs.replace(STATUS, cameras={"north": health})
        state = ArenaState(
            now_s=now,
            cameras={"north": TimedMessage(own, 0.0)},
            status=TimedMessage(status, 0.0),
            rig=rig,
        )
        return tabulate_cameras(state).rows[0].note

    assert advice(health).startswith("moved")
    assert advice(msgspec.structs.replace(health, calibrated=False)) == "not calibrated"
    accepted = msgspec.structs.replace(health, calibrated=False, excluded=False)
    assert advice(accepted, rig=four_cameras()) == "too dark", "a rig arrives before the server's next status"
    assert (
        advice(msgspec.structs.replace(health, excluded=False, duplicate_publisher=True))
        == "two nodes use this name"
    )
    assert advice(msgspec.structs.replace(health, excluded=False)) == "too dark"
    assert advice(health, now=2 * STALE_S).startswith("silent for 4 s: check its cable")


def test_names_are_escaped():
    """A camera's name cannot add a script to the page."""
    status = {"<script>": TimedMessage(None, -1e9)}
    html = tabulate_cameras(ArenaState(cameras=status)).html() + status_line("bad", "<script>")
    assert "<script>" not in html
    assert "&lt;script&gt;" in html


def test_a_robot_with_misplaced_markers_has_a_note(arena: LiveArena, feed: Feed):
    """The row is a warning with the difference."""
    arena.pose("rover", (0, 0, 0))
    found = Contradiction(kind="robot", names=("rover",), error_over_claim=9.0, size_mm=2.34)
    arena.status(contradictions=(found,))
    wait_for(lambda: (x := feed.state()).poses and x.status)
    (row,) = tabulate_robots(feed.state()).rows
    assert (row.cells[1], row.level) == ("tracked", "warn")
    assert "2.3 mm" in row.note


def test_a_large_standard_deviation_is_short():
    assert [format_sigma(mm) for mm in (0.44, 999.0, 1_327_600.6)] == ["0.4", "999.0", "> 1 m"]


def test_an_old_pose_has_no_state(arena: LiveArena, feed: Feed):
    arena.pose("rover", (0, 0, 0))
    wait_for(lambda: feed.state().poses)
    state = feed.state()
    state.poses["rover"] = replace(state.poses["rover"], received_s=time.monotonic() - 2 * STALE_S)
    (row,) = tabulate_robots(state).rows
    assert (row.cells[1:], row.level) == (("no data", "–", "–", "–", "–", "–"), "bad")


def test_the_status_line_of_an_empty_arena():
    assert (
        describe_arena(ArenaState()) == "no server found yet | no camera | 0 calibrated | no robot | 0 faults"
    )


def test_an_absent_server_is_offline(arena: LiveArena, feed: Feed):
    """Its last figures are not shown."""
    token = arena.session.liveliness().declare_token(arena.keys.fusion_alive)
    arena.status()
    wait_for(lambda: feed.state().status and feed.state().server_alive)
    assert describe_server(feed.state()).startswith("30 frame sets/s, latency 7.7 ms")
    token.undeclare()
    wait_for(lambda: not feed.state().server_alive)
    assert describe_server(feed.state()) == "the server is offline"


def test_coverage_counts_cells_and_ignores_the_outside(arena: LiveArena, feed: Feed):
    """Detections at the centres of all cells cover the image; those outside cover nothing."""
    cells = cell_centres(640, 480)
    arena.detections("north", [(u, v) for u, v in cells.tolist()])
    arena.detections("east", [(-5.0, 10.0), (639.6, 10.0), (1e4, 1e4)])
    wait_for(lambda: len(feed.state().coverage) == 2)
    coverage = feed.state().coverage
    assert coverage["north"].share() == 1.0
    assert coverage["east"].share() == 0.0
    drawn = [draw_cells(coverage[name], "") for name in ("north", "east")]
    assert [text.count("height:12px") for text in drawn] == [len(cells)] * 2
    assert drawn[0] != drawn[1]


def test_trails_are_bounded_and_end_at_the_robot():
    """A trail has a fixed number of points; the last one is the robot's position."""
    trails = Trails()
    for k in range(5 * LENGTH):
        trails.add("rover", (k, 0.0, 0.0))
    trails.add("drone", (0.0, 1.0, 0.0))
    segments = trails.segments(["rover", "drone"])
    assert segments.shape == (2 * (LENGTH - 1), 2, 3)
    assert segments[LENGTH - 2, 1].tolist() == [5 * LENGTH - 1, 0.0, 0.0]
    assert (segments[1 : LENGTH - 1, 0] == segments[: LENGTH - 2, 1]).all(), "the segments are connected"
    assert (segments[LENGTH - 1 :] == [0.0, 1.0, 0.0]).all()


def test_a_jump_restarts_the_trail():
    """The whole trail is at the new position."""
    trails = Trails()
    for place in ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 2.0, 0.0)):
        trails.add("rover", place)
    assert (trails.segments(["rover"]) == [0.5, 2.0, 0.0]).all()


def test_a_trail_fades_into_the_background():
    """From the background's colour to the robot's."""
    colours = fade(np.array([[10, 200, 30], [0, 0, 255]], np.uint8), (5, 5, 5))
    assert colours.shape == (2 * (LENGTH - 1), 2, 3)
    assert colours[0, 0].tolist() == [5, 5, 5]
    assert colours[LENGTH - 2, 1].tolist() == [10, 200, 30]
