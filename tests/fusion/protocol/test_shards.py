# SPDX-License-Identifier: BSD-3-Clause
"""Two processes' worth of robots: who is whose, and that no shard takes the other's detections."""

import contextlib
import itertools
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from camera_node.foundation.errors import ConfigError, NetworkError
from camera_node.protocol.messages import MessageError, decode, encode
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.robots import Robot
from fusion.protocol.pose_messages import RobotPose, ShardPoses
from fusion.protocol.shards import Shard
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.server.server import Server
from fusion.tracking.result import TrackingResult
from fusion.tracking.tracker import Tracker
from tests.fusion.serving import config, live, running_server, send, serving
from tests.fusion.synthetic import PERIOD_NS, TRIANGLE, WIDE, Arena, line
from tests.fusion.tracks import errors
from tests.waiting import DEADLINE_S, wait_for

NAMES = [f"robot_{k}" for k in range(200)]


def test_every_robot_has_one_shard_independent_of_the_other_names():
    shards = [Shard(k, 3) for k in (1, 2, 3)]
    owners = [[shard.owns(name) for shard in shards] for name in NAMES]
    assert all(sum(row) == 1 for row in owners)
    assert np.sum(owners, axis=0).min() > 200 / 3 - 4 * np.sqrt(
        200 * 2 / 9
    )  # names are distributed at random; 4 sigma
    assert Shard.parse("2/3") == shards[1]


@pytest.mark.parametrize("text", ["", "2", "0/2", "3/2", "1/65", "a/b", "-1/2"])
def test_invalid_shards_are_refused(text):
    with pytest.raises(ConfigError, match="write it as 1/2"):
        Shard.parse(text)


def near(pose: RobotPose | None, place: tuple[float, float, float]) -> bool:
    return pose is not None and bool(np.abs(np.subtract(pose.position, place)).max() < 5e-3)


def test_crossing_robots_of_different_shards_keep_their_detections():
    """One robot passes 0.15 m above another, a third one above both, with relative speeds up to 2.4 m/s: in many
    images their markers are interleaved. Each shard receives the other's robots one frame set late, as encoded bytes.
    No detection is used by both, and all position errors are below 5 mm, the sum of noise and unmodelled motion."""
    mine, other = (next(name for name in NAMES if Shard(k, 2).owns(name)) for k in (1, 2))
    third = [name for name in NAMES if Shard(2, 2).owns(name)][1]
    motions = {
        mine: line((-0.6, 0.0, 0.15), (1.2, 0, 0), turn=(0, 0, 1.0)),
        other: line((0.6, 0.05, 0.30), (-1.2, 0, 0)),
        third: line((0.0, 0.6, 0.45), (0, -1.2, 0)),
    }
    robots = {mine: TRIANGLE, other: WIDE, third: Robot(diameter_m=0.12)}
    arena = Arena(robots, motions, sigma_px=0.05, distractors=2)
    trackers = [Tracker(arena.cameras, robots, shard=Shard(k, 2)) for k in (1, 2)]
    n_shared = 0
    for k, frame_set in enumerate(synchronize(arena.frames(30))):
        fused = [tracker.track(frame_set) for tracker in trackers]
        used = [used_detections(tracker, result) for tracker, result in zip(trackers, fused, strict=True)]
        assert not used[0] & used[1]
        n_shared += bool(used[0]) and bool(used[1])
        for tracker, other_tracker in zip(trackers, trackers[::-1], strict=True):
            other_tracker.table.receive(decode(encode(tracker.table.shard_poses()), ShardPoses))
        poses = [pose for one in fused for pose in one.poses]
        assert len({pose.robot for pose in poses}) == len(poses)
        if k > 3:
            assert {pose.robot for pose in poses if pose.state == "tracked"} == set(robots)
            assert np.abs(errors(arena, poses)[:, 3:]).max() < 5e-3
    assert n_shared > 20


def test_the_other_shards_robots_have_their_detections_at_ten_frame_sets_a_second():
    """Between two frame sets a prediction becomes uncertain; the other shard's robots are tracked nevertheless, so a
    single marker beside them has no rival."""
    mine, other = (next(name for name in NAMES if Shard(k, 2).owns(name)) for k in (1, 2))
    single = [name for name in NAMES if Shard(2, 2).owns(name)][1]
    motions = {mine: line((-0.3, 0.1, 0.2)), other: line((0.3, -0.1, 0.2)), single: line((0.0, 0.4, 0.2))}
    robots = {mine: TRIANGLE, other: WIDE, single: Robot(diameter_m=0.12)}
    arena = Arena(robots, motions, sigma_px=0.05)
    trackers = [Tracker(arena.cameras, robots, shard=Shard(k, 2)) for k in (1, 2)]
    poses: list[RobotPose] = []
    for frame_set in synchronize(arena.frames(60))[::3]:
        fused = [tracker.track(frame_set) for tracker in trackers]
        poses = [pose for one in fused for pose in one.poses]
        for tracker, other_tracker in zip(trackers, trackers[::-1], strict=True):
            other_tracker.table.receive(decode(encode(tracker.table.shard_poses()), ShardPoses))
    assert {pose.robot for pose in poses if pose.state == "tracked"} == set(robots)
    assert np.abs(errors(arena, poses)[:, 3:]).max() < 5e-3


def synchronize(frames: list[CalibratedFrame]) -> list[FrameSet]:
    """All frame sets of a run, in order."""
    synchronizer = FrameSynchronizer(PERIOD_NS)
    for frame in frames:
        synchronizer.add(frame)
    return synchronizer.finish()


def used_detections(tracker: Tracker, result: TrackingResult) -> set[int]:
    """The detections that a shard used for its own robots."""
    own = tracker.table.owned[tracker.table.markers.robot[result.assignments.marker]]
    return set(result.assignments.detection[own].tolist())


@pytest.mark.parametrize(
    "wrong",
    [
        {"motion": b"\0" * 8},
        {"states": ()},
        {"covariance": b"\xff" * 576},
        {"motion": b"\0" * 104},
        {"motion": np.full(13, 1e308).tobytes()},
    ],
)
def test_invalid_shard_poses_are_refused(wrong: dict):
    poses = ShardPoses(
        t_ns=0, robots=("a",), states=("tracked",), motion=np.eye(1, 13, 3).tobytes(), covariance=b"\0" * 576
    )
    assert decode(encode(poses), ShardPoses) == poses
    with pytest.raises(MessageError):
        decode(encode(msgspec.structs.replace(poses, **wrong)), ShardPoses)


def test_two_shards_on_loopback_each_track_their_own_robots(tmp_path):
    """Two constellations, and a single marker of the other shard nearby. Each pose is published by one shard, all are
    right once the velocities are known, and the leading shard labels the markers of both."""
    mine = next(name for name in NAMES if Shard(1, 2).owns(name))
    other = next(name for name in NAMES if Shard(2, 2).owns(name))
    single = [name for name in NAMES if Shard(2, 2).owns(name)][1]
    places = {mine: (-0.3, 0.1, 0.2), other: (0.3, -0.1, 0.2), single: (0.0, 0.4, 0.2)}
    robots = {mine: TRIANGLE, other: WIDE, single: Robot(diameter_m=0.12)}
    arena = Arena(robots, {name: line(at) for name, at in places.items()}, sigma_px=0.05)
    first = msgspec.structs.replace(config(tmp_path), shard="1/2", limits=Limits(lateness_ms=200))
    (tmp_path / "robots.yaml").write_bytes(msgspec.yaml.encode({"robots": msgspec.to_builtins(robots)}))
    with serving(first) as (server, client):
        other_shard = msgspec.structs.replace(first, shard="2/2", listen=server.endpoints)
        with Server(other_shard) as second, running_server(second):
            streams = {name: client.robot(name, DEADLINE_S) for name in robots}
            markers = client.markers(DEADLINE_S)

            labels: set[int] = set()
            seeds = itertools.count()
            markers.on_message(lambda message: labels.update(message.robot_index().tolist()))

            def are_all_right() -> bool:
                """Publish frames of the present time, paced by the replies, so that the shards stay synchronized."""
                noisy = replace(arena, seed=next(seeds))  # an identical image would be a frozen one
                send(server, live(noisy.messages(1), ago_ns=0))
                with contextlib.suppress(NetworkError):
                    markers.next(0.04)
                are_near = all(near(s.latest(), places[name]) for name, s in streams.items())
                return are_near and labels >= {0, 1, 2}

            wait_for(are_all_right)
            assert server.pipeline.tracker is not None
            assert second.pipeline.tracker is not None
            assert server.pipeline.tracker.table.owned.tolist() == [True, False, False]
            assert second.pipeline.tracker.table.owned.tolist() == [False, True, True]
