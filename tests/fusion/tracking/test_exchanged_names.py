# SPDX-License-Identifier: BSD-3-Clause
"""Cameras that have each other's names are found, and nothing else is taken for them."""

import logging
from collections.abc import Iterable
from concurrent.futures import Executor, Future
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from calib.rig.camera import Camera
from camera_node.geometry.pose import Pose, rotation_from_vector
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.observations import CameraArray
from fusion.protocol.arena_health import describe_contradiction
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.exchanged_names import Order, find_order
from fusion.tracking.tracker import Tracker
from tests.fusion.moved_camera import MOTIONS, ROBOTS, black
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, Arena, line, ring

DIAMETERS = np.array([0.12])
TWO, CYCLE = {"cam0": "cam2", "cam2": "cam0"}, {"cam0": "cam1", "cam1": "cam3", "cam3": "cam0"}
PAIRS = {"cam0": "cam1", "cam1": "cam0", "cam4": "cam6", "cam6": "cam4"}
ONE = {"a": TRIANGLE}, {"a": line((-0.3, 0.2, 0.2), (0.2, 0.1, 0.0), turn=(0.0, 0.0, 0.5))}


def lenses(n: int) -> dict[str, Camera]:
    """Cameras at irregular places, of which each has another lens."""
    rng = np.random.default_rng(n)
    cameras = {}
    for name, camera in ring(n).items():
        T = camera.matrix()
        T[:3, 3] += rng.uniform(-0.4, 0.4, 3)
        focal = 1.0 + 0.1 * rng.uniform()
        cameras[name] = msgspec.structs.replace(
            camera, fx=focal * camera.fx, fy=focal * camera.fy, T_world_cam=Pose.from_matrix(T)
        )
    return cameras


def arena_of(cameras: dict[str, Camera], is_single: bool = False, distractors: int = 0) -> Arena:
    robots, motions = ONE if is_single else (ROBOTS, MOTIONS)
    phases = tuple(np.linspace(-0.45, 0.45, len(cameras)).tolist())
    return Arena(robots, motions, cameras=cameras, sigma_px=0.1, phases=phases, distractors=distractors)


def renamed(
    frames: Iterable[CalibratedFrame], order: Order, cameras: dict[str, Camera]
) -> list[CalibratedFrame]:
    """What a server makes of frames whose cameras have the names by which `order` explains them."""
    name_of = {true: name for name, true in order.items()}
    found = []
    for frame in frames:
        name = name_of.get(frame.camera, frame.camera)
        by_other = frame.recalibrated(cameras[frame.camera], cameras[name])
        found.append(replace(by_other, camera=name))
    return found


def frame_set_of(frames: list[CalibratedFrame], n: int) -> FrameSet:
    return FrameSet(frames[n // 2].t_ns, tuple(frames[:n]))


@pytest.mark.parametrize(
    ("n", "order"),
    [(3, TWO), (4, TWO), (4, CYCLE), (6, TWO), (6, CYCLE), (8, TWO), (8, PAIRS), (6, {}), (3, {})],
)
def test_one_frame_set_shows_which_names_are_exchanged(n: int, order: Order):
    """Of cameras with other lenses."""
    cameras = lenses(n)
    frames = renamed(arena_of(cameras).frames(1), order, cameras)
    assert find_order(frame_set_of(frames, n), CameraArray(cameras), DIAMETERS) == order


@pytest.mark.parametrize(("n", "order"), [(3, TWO), (4, CYCLE), (6, CYCLE), (8, TWO), (6, {}), (3, {})])
def test_three_markers_of_one_robot_show_it(n: int, order: Order):
    cameras = lenses(n)
    frames = renamed(arena_of(cameras, is_single=True).frames(1), order, cameras)
    assert find_order(frame_set_of(frames, n), CameraArray(cameras), DIAMETERS) == order


@pytest.mark.parametrize(("n", "found"), [(4, None), (6, TWO)])
def test_a_regular_ring_has_the_order_that_renames_fewest(n: int, found: Order | None):
    """A ring of equal cameras looks the same if all are exchanged by one turn of it; of four, if the others of two that
    face each other are exchanged."""
    cameras = ring(n)
    frames = renamed(arena_of(cameras).frames(1), TWO, cameras)
    assert find_order(frame_set_of(frames, n), CameraArray(cameras), DIAMETERS) == found


@pytest.mark.parametrize("n", [3, 4, 6])
@pytest.mark.parametrize("degrees", [0.3, 3.0, 20.0])
def test_cameras_that_turned_are_not_exchanged(n: int, degrees: float):
    cameras = lenses(n)
    turned = dict(cameras)
    for name, turn in (("cam0", (0.6, 0.64, 0.48)), ("cam1", (-0.48, 0.6, 0.64))):
        T = cameras[name].matrix()
        T[:3, :3] = T[:3, :3] @ rotation_from_vector(np.radians(degrees) * np.array(turn))
        turned[name] = msgspec.structs.replace(cameras[name], T_world_cam=Pose.from_matrix(T))
    frames = arena_of(cameras).frames(1)
    assert not find_order(frame_set_of(frames, n), CameraArray(turned), DIAMETERS)


@pytest.mark.parametrize("n", [3, 4, 6, 8])
@pytest.mark.parametrize("seed", range(5))
def test_images_without_common_markers_show_no_order(n: int, seed: int):
    """As of posters, of which each camera sees others."""
    arena = replace(arena_of(lenses(n), distractors=15), hidden=lambda *_: True, seed=seed)
    assert not find_order(frame_set_of(arena.frames(1), n), CameraArray(arena.cameras), DIAMETERS)


def follow(tracker: Tracker, frames: Iterable[CalibratedFrame]) -> list[int]:
    """How many robots are tracked in each frame set."""
    synchronizer, tracked = FrameSynchronizer(PERIOD_NS), []
    for frame in frames:
        synchronizer.add(frame)
        for frame_set in synchronizer.take(frame.t_ns):
            tracked.append(sum(pose.state == "tracked" for pose in tracker.track(frame_set).poses))
            tracker.check_extrinsics(frame_set)
    return tracked


def test_exchanged_cameras_are_reported_and_left_out_until_they_have_their_names(caplog):
    """The four others track on, and none of them is blamed; other robots change nothing, nor do images in which the two
    show nothing."""
    cameras = lenses(6)
    frames = arena_of(cameras).frames(300)
    part = len(frames) // 5
    tracker = Tracker(cameras, ROBOTS)
    follow(tracker, renamed(frames[:part], TWO, cameras))
    assert [c.kind for c in tracker.contradictions()] == ["names"]
    follow(tracker, [black(f) if f.camera in TWO else f for f in frames[part : 2 * part]])
    (found,) = tracker.contradictions()
    assert (found.kind, found.names) == ("names", ("cam0", "cam2"))
    assert describe_contradiction(found) in caplog.text
    assert describe_contradiction(found) == (
        "cameras cam0, cam2 have exchanged names: cam0 shows what cam2 should, cam2 shows what cam0 should; they are "
        "not used until each node starts with its own name"
    )
    assert tracker.monitors.rig.excluded == set()
    other = tracker.with_robots({"a": TRIANGLE}, {})
    assert other.contradictions() == (found,)
    with caplog.at_level(logging.INFO, "fusion"):
        tracked = follow(tracker, frames[2 * part :])
    assert set(tracked[2:]) == {len(ROBOTS)}
    assert tracker.contradictions() == ()
    assert "no names are exchanged any more" in caplog.text


class Broken(Executor):
    """A process that ends during its jobs."""

    def submit(self, fn, /, *args, **kwargs):
        future = Future()
        future.set_exception(OSError("ended"))
        return future


def test_a_look_that_fails_changes_nothing(caplog):
    cameras = lenses(4)
    tracker = Tracker(cameras, ROBOTS)
    tracker.names.executor = Broken()
    assert set(follow(tracker, arena_of(cameras).frames(40))[2:]) == {len(ROBOTS)}
    assert "the names of the cameras can't be checked" in caplog.text
