# SPDX-License-Identifier: BSD-3-Clause
"""What panel and status line say."""

import time
from dataclasses import replace

import msgspec
import numpy as np

from camera_node.protocol.messages import CameraStatus
from fusion.protocol.messages import CameraHealth, FusionStatus
from tests.web.conftest import Played, wait_for
from web.coverage import Coverage, montage
from web.feed import Feed, Latest, Seen
from web.tables import (
    STALE_S,
    Row,
    describe,
    describe_server,
    describe_sigma,
    tabulate_cameras,
    tabulate_robots,
)
from web.trails import LENGTH, Trails, fade


def test_the_tables_show_what_was_sent(played: Played, feed: Feed):
    """Each figure stands in its column, and the covariance as millimetres."""
    played.pose("rover", (0.5, -0.25, 0.125))
    played.camera("north", advice="too dark")
    played.status()
    wait_for(lambda: (x := feed.latest()).poses and x.cameras and x.status)
    latest = feed.latest()
    robot = ("rover", "tracked", "+0.50 -0.25 +0.12", "0.50", "1.0", "3")
    assert tabulate_robots(latest).rows == [Row(robot, "ok")]
    camera = ("north", "30.0", "0.71", "8.0", "0.08", "5.1", "0.02", "2 / 1")
    assert tabulate_cameras(latest).rows == [Row(camera, "warn", "too dark")]


def test_a_camera_that_does_not_count_is_told():
    """Silent, not placed, or moved; else what its node advises."""
    health = CameraHealth(
        fps=30.0,
        lateness_ms=5.0,
        residual_px=None,
        assigned=0,
        unassigned=0,
        late=0,
        calibrated=True,
        excluded=True,
    )
    own = CameraStatus(
        camera="north",
        t_ns=0,
        width=640,
        height=480,
        fps=30.0,
        frames=1,
        dropped=0,
        detect_ms=0.5,
        roundels=0.0,
        saturated=0.0,
        advice="too dark",
    )

    def advice(health: CameraHealth, now: float = 0.0) -> str:
        status = FusionStatus(
            t_ns=0,
            frame_sets_per_s=30.0,
            latency_ms=None,
            cpu=0.1,
            memory_mb=100.0,
            cameras={"north": health},
            robots={},
            faults={},
        )
        latest = Latest(now=now, cameras={"north": Seen(own, 0.0)}, status=Seen(status, 0.0))
        return tabulate_cameras(latest).rows[0].note

    assert advice(health) == "moved: excluded until it is recalibrated"
    assert advice(msgspec.structs.replace(health, calibrated=False)) == "not placed"
    assert (
        advice(msgspec.structs.replace(health, excluded=False, duplicate_publisher=True))
        == "two nodes have this name"
    )
    assert advice(msgspec.structs.replace(health, excluded=False)) == "too dark"
    assert advice(health, now=2 * STALE_S) == "away"


def test_names_are_escaped():
    """A camera's name can't bring a script into the page."""
    status = {"<script>": Seen(None, -1e9)}
    html = tabulate_cameras(Latest(cameras=status)).html()
    assert "<script>" not in html
    assert "&lt;script&gt;" in html


def test_a_robot_whose_markers_are_off_is_told(played: Played, feed: Feed):
    """By how much, and not as one that is well."""
    played.pose("rover", (0, 0, 0))
    played.status(misfits={"rover": 2.34})
    wait_for(lambda: (x := feed.latest()).poses and x.status)
    (row,) = tabulate_robots(feed.latest()).rows
    assert (row.cells[1], row.hue) == ("tracked", "warn")
    assert row.note.startswith("its markers are off by 2.3 px")


def test_where_a_lost_robot_may_be_is_no_column_of_digits():
    assert [describe_sigma(mm) for mm in (0.44, 999.0, 1_327_600.6)] == ["0.4", "999.0", "> 1 m"]


def test_a_silent_robot_is_away(played: Played, feed: Feed):
    """A pose that is too old tells no state, whatever it says."""
    played.pose("rover", (0, 0, 0))
    wait_for(lambda: feed.latest().poses)
    latest = feed.latest()
    latest.poses["rover"] = replace(latest.poses["rover"], at=time.monotonic() - 2 * STALE_S)
    (row,) = tabulate_robots(latest).rows
    assert (row.cells[1], row.hue) == ("away", "bad")


def test_the_status_line_of_nothing():
    """An empty arena is told as one, on one line."""
    assert describe(Latest()) == "no server answers yet | no camera | 0 placed | no robot | 0 faults"


def test_a_server_that_left_is_told(played: Played, feed: Feed):
    """Old figures are not shown as present ones."""
    token = played.session.liveliness().declare_token(played.keys.fusion_alive)
    played.status()
    wait_for(lambda: feed.latest().status and feed.latest().server_alive)
    assert describe_server(feed.latest()).startswith("30 poses/s, latency 7.7 ms")
    token.undeclare()
    wait_for(lambda: not feed.latest().server_alive)
    assert describe_server(feed.latest()) == "the server is away"


def test_coverage_counts_cells_and_ignores_the_outside(played: Played, feed: Feed):
    """A detection at every cell's middle covers all; one outside the image covers nothing."""
    grid = (np.arange(8) + 0.5) / 8
    played.detections("north", [(640 * u - 0.5, 480 * v - 0.5) for u in grid for v in grid])
    played.detections("east", [(-5.0, 10.0), (639.6, 10.0), (1e4, 1e4)])
    wait_for(lambda: len(feed.latest().coverage) == 2)
    coverage = feed.latest().coverage
    assert coverage["north"].share == 1.0
    assert coverage["east"].share == 0.0
    assert coverage["north"].image().shape == (120, 160, 3)


def test_coverage_of_an_odd_image():
    """A line of pixels has a picture too."""
    assert Coverage(32768, 1).image().shape == (1, 160, 3)
    assert Coverage(1, 32768).image().shape == (640, 160, 3)


def test_a_montage_has_room_for_all():
    """Two in a row, whatever their shapes; and none is a picture as well."""
    assert montage({}).shape == (1, 328, 3)
    assert montage({"a": Coverage(640, 480), "b": Coverage(480, 640), "c": Coverage(640, 480)}).shape == (
        2 * (18 + 213),
        328,
        3,
    )


def test_trails_are_bounded_and_end_at_the_robot():
    """However long it drives, a trail has as many points; its last one is where the robot is."""
    trails = Trails()
    for k in range(5 * LENGTH):
        trails.add("rover", (k, 0.0, 0.0))
    trails.add("drone", (0.0, 1.0, 0.0))
    segments = trails.segments(["rover", "drone"])
    assert segments.shape == (2 * (LENGTH - 1), 2, 3)
    assert segments[LENGTH - 2, 1].tolist() == [5 * LENGTH - 1, 0.0, 0.0]
    assert (segments[1 : LENGTH - 1, 0] == segments[: LENGTH - 2, 1]).all(), "a trail is one line"
    assert (segments[LENGTH - 1 :] == [0.0, 1.0, 0.0]).all()


def test_a_robot_that_is_put_elsewhere_leaves_no_line():
    """All of its trail is where it is now."""
    trails = Trails()
    for place in ((0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.5, 2.0, 0.0)):
        trails.add("rover", place)
    assert (trails.segments(["rover"]) == [0.5, 2.0, 0.0]).all()


def test_fading_ends_in_the_robots_colour():
    """From the background to the robot's own."""
    colours = fade(np.array([[10, 200, 30], [0, 0, 255]], np.uint8), (5, 5, 5))
    assert colours.shape == (2 * (LENGTH - 1), 2, 3)
    assert colours[0, 0].tolist() == [5, 5, 5]
    assert colours[LENGTH - 2, 1].tolist() == [10, 200, 30]
