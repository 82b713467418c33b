# SPDX-License-Identifier: BSD-3-Clause
"""The status line names the worst fault and what to do; the next step follows the order of the work."""

import re
from dataclasses import replace

import msgspec
import pytest

from camera_node.protocol.server_connection import ServerConnection
from fusion.protocol.pose_messages import Contradiction, FusionStatus
from tests.messages import STATUS
from tests.waiting import wait_for
from tests.web.arena import LiveArena, four_cameras
from web.colours import own_colours, robot_colour
from web.condition import CONNECT_S, Condition, assess, next_step
from web.state.feed import ArenaState, Feed, TimedMessage
from web.state.subscription import Subscription

ENDPOINT = "tcp/lab:7447"


@pytest.fixture
def healthy(arena: LiveArena, feed: Feed) -> ArenaState:
    """The state of an arena that tracks its robot."""
    token = arena.session.liveliness().declare_token(arena.keys.fusion_alive)
    for name in four_cameras().cameras:
        arena.camera(name)
    arena.pose("rover", (0.5, 0.0, 0.1))
    arena.status(tuple(four_cameras().cameras))
    arena.rig(four_cameras())
    wait_for(
        lambda: (s := feed.state()).rig and s.server_alive and s.poses and s.status and len(s.cameras) == 4
    )
    state = feed.state()
    token.undeclare()
    return state


def with_silent(state: ArenaState, camera: str, seconds: float) -> ArenaState:
    state.cameras[camera] = TimedMessage(state.cameras[camera].message, state.now_s - seconds)
    return state


def test_a_healthy_arena_is_green(healthy: ArenaState):
    condition = assess(healthy, ENDPOINT)
    assert condition.level == "ok"
    assert condition.text == "4 cameras, 1 robot tracked, 30 poses/s, latency 8 ms"
    assert next_step(healthy) == "run"


def test_a_silent_camera_is_red_and_comes_first(healthy: ArenaState):
    """Before the advice of another camera; the number of further faults is given."""
    healthy.poses["rover"] = TimedMessage(healthy.poses["rover"].message, healthy.now_s - 9)
    condition = assess(with_silent(healthy, "north", 4.2), ENDPOINT)
    assert condition.level == "bad"
    assert condition.text == "camera north silent for 4 s: check its cable and its program (and 1 more)"


def test_a_camera_that_contradicts_the_others_is_named_with_millimetres(healthy: ArenaState):
    """Before the advice of its node, which a moved camera may have, too: poses are wrong, and do not say so."""
    assert healthy.status is not None
    moved = Contradiction(kind="camera", names=("east",), size_mm=4.2, error_over_claim=9.0)
    status = msgspec.structs.replace(healthy.status.message, contradictions=(moved,))
    healthy.status = TimedMessage(status, healthy.now_s)
    node = msgspec.structs.replace(healthy.cameras["north"].message, advice="too dark")
    healthy.cameras["north"] = TimedMessage(node, healthy.now_s)
    condition = assess(healthy, ENDPOINT)
    assert condition.level == "warn"
    assert condition.text.startswith("camera east contradicts the other cameras by 4.2 mm")
    assert condition.text.endswith("calibrate it again (and 1 more)")


def test_a_camera_that_the_server_does_not_list_is_not_silent(healthy: ArenaState):
    """It has another name from now on, and disappears; one whose name the server lists is red."""
    status: FusionStatus = healthy.status.message  # pyright: ignore[reportOptionalMemberAccess]
    renamed = with_silent(healthy, "north", 4.2)
    assert assess(renamed, ENDPOINT).level == "bad"
    del status.cameras["north"]
    assert assess(renamed, ENDPOINT).level == "ok"


def test_a_calibration_that_runs_comes_before_its_absence(healthy: ArenaState):
    """The line says what to do in it; a silent camera is worse."""
    uncalibrated = replace(healthy, rig=None)
    assert assess(uncalibrated, ENDPOINT).text.startswith("the cameras are not calibrated")
    for state in (uncalibrated, healthy):
        assert assess(state, ENDPOINT, "wave the wand") == Condition("warn", "wave the wand")
    assert assess(with_silent(healthy, "north", 4.2), ENDPOINT, "wave the wand").level == "bad"


def test_a_robot_that_is_not_found_is_amber_with_its_reason(healthy: ArenaState):
    status: FusionStatus = healthy.status.message  # pyright: ignore[reportOptionalMemberAccess]
    status.not_acquired["cart"] = "2 of 4 markers seen"
    condition = assess(healthy, ENDPOINT)
    assert (condition.level, condition.text) == ("warn", "robot cart is not found: 2 of 4 markers seen")


def test_a_lost_server_hides_all_other_faults(healthy: ArenaState):
    """Its cameras and robots are silent too."""
    healthy.now_s += 60.0
    condition = assess(healthy, ENDPOINT)
    assert condition.level == "bad"
    assert condition.text.startswith("the server is silent for 60 s")
    assert "more" not in condition.text


def test_the_absence_of_a_server_is_a_fault_after_a_while():
    assert assess(ArenaState(now_s=CONNECT_S / 2), ENDPOINT).level == "wait"
    late = assess(ArenaState(now_s=CONNECT_S + 1), ENDPOINT)
    assert late.level == "bad"
    assert ENDPOINT in late.text


def test_the_name_of_another_arena_is_told(arena: LiveArena):
    """A page that takes the name that the line proposes finds the server."""
    token = arena.session.liveliness().declare_token(arena.keys.fusion_alive)
    with ServerConnection([arena.endpoint]) as connection:
        wrong = Feed("tset")
        subscription = Subscription(connection, wrong)
        wait_for(lambda: wrong.state().other_arenas)
        state = wrong.state()
        text = assess(replace(state, now_s=state.started_s + CONNECT_S + 1), ENDPOINT).text
        subscription.close()
        (named,) = re.findall(r"there is no arena 'tset', but test.*; give --arena (\w+)", text)
        right = Feed(named)
        subscription = Subscription(connection, right)
        wait_for(lambda: right.state().server_alive)
        subscription.close()
    token.undeclare()


def test_cameras_that_locate_by_themselves_need_no_server():
    """A server that was seen is missed all the same, and a camera that went silent is red."""
    located = TimedMessage(None, 9.5)
    state = ArenaState(now_s=10.0, relative={"scout": located, "mule": located})
    condition = assess(state, ENDPOINT)
    assert condition == Condition("ok", "2 cameras locate roundels relative to themselves, without a server")
    assert next_step(state) == "run"
    state.cameras["mule"] = TimedMessage(None, 6.0)
    assert assess(state, ENDPOINT).text.startswith("camera mule silent for 4 s")
    state.relative = {"scout": TimedMessage(None, 1.0)}
    assert assess(state, ENDPOINT).text.startswith("no server at")


def test_the_steps_are_in_the_order_of_the_work(arena: LiveArena, feed: Feed):
    """Cameras first, then their calibration, then floor and origin, then robots."""
    assert next_step(feed.state()) == "cameras"
    arena.camera("north")
    wait_for(lambda: feed.state().cameras)
    assert next_step(feed.state()) == "calibrate"
    arena.rig(four_cameras())
    wait_for(lambda: feed.state().rig)
    state = feed.state()
    state.status, state.server_alive = TimedMessage(STATUS, state.now_s), True
    assert state.rig is not None
    by_wand = msgspec.structs.replace(state.rig, calibration={"grade": "B"})
    floor = replace(state, rig=by_wand)
    assert next_step(floor) == "floor"
    assert assess(floor, ENDPOINT).text.startswith("floor and origin are not defined: stand the wand")
    with_world = replace(
        state, rig=msgspec.structs.replace(by_wand, calibration={"grade": "B", "world": {"date": "today"}})
    )
    for ready in (state, with_world):  # the first one was not placed by a wand: its world is its own
        assert next_step(ready) == "robots"
        assert assess(ready, ENDPOINT).text.startswith("no robot is declared")


def test_a_robot_s_colour_derives_from_its_name():
    """The colours of others do not matter, and similar names differ."""
    names = [f"robot_{k}" for k in range(50)]
    assert own_colours(names)[7].tolist() == own_colours(["robot_7"])[0].tolist()
    assert len({robot_colour(name) for name in names}) > 45, "a collision is rare"


def test_a_removed_robot_disappears(arena: LiveArena, feed: Feed):
    """The status no longer lists it; a new robot without a status yet stays."""
    arena.pose("old", (0, 0, 0))
    wait_for(lambda: "old" in feed.state().poses)

    def speak() -> None:
        arena.pose("rover", (0, 0, 0))
        arena.pose("new", (0, 0, 0))
        arena.status()

    wait_for(lambda: set(feed.state().poses) == {"rover", "new"}, speak)
