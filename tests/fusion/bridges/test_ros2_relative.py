# SPDX-License-Identifier: BSD-3-Clause
"""What a robot's camera locates, in ROS 2. The oracle is `rosbags`, an independent implementation of ROS's messages."""

import subprocess

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore

from camera_node.geometry.pose import rotation_from_wxyz
from camera_node.protocol.messages import Keys, encode
from camera_node.protocol.session import open_client, open_router
from fusion.bridges.ros2_messages import ANY_ANGLE, relative_poses
from fusion.bridges.ros2_types import POSE_WITH_COVARIANCE_STAMPED as RELATIVE
from tests.camera_node.protocol.positions import pack_random
from tests.conftest import free_port
from tests.processes import running
from tests.waiting import Inbox, wait_for

ROS = get_typestore(Stores.ROS2_JAZZY)
SENT = pack_random(3, "scout.1")


@pytest.mark.parametrize("frame", ["", "map", "world", "arena1"])  # lengths with every remainder modulo four
def test_bytes_are_those_of_ros(frame: str):
    for data in relative_poses(SENT, frame):
        assert bytes(ROS.serialize_cdr(ROS.deserialize_cdr(data, RELATIVE), RELATIVE)) == data


def test_messages_have_position_normal_and_covariance():
    """The z axis is the likelier normal. Across it, the variance is the claimed one plus that of the other normal."""
    seen = SENT.unpack()
    for k, data in enumerate(relative_poses(SENT, "scout_optical_frame")):
        message = ROS.deserialize_cdr(data, RELATIVE)
        stamp, place, q = message.header.stamp, message.pose.pose.position, message.pose.pose.orientation  # pyright: ignore[reportAttributeAccessIssue]: created at run time
        assert stamp.sec * 10**9 + stamp.nanosec == SENT.t_ns
        assert (place.x, place.y, place.z) == tuple(seen.position[k])
        R, (first, second) = rotation_from_wxyz([q.w, q.x, q.y, q.z]), seen.normals[k]
        assert R[:, 2] == pytest.approx(first, abs=1e-6)
        assert np.linalg.det(R) == pytest.approx(1)
        C = message.pose.covariance.reshape(6, 6)  # pyright: ignore[reportAttributeAccessIssue]
        assert pytest.approx(seen.cov[k]) == C[:3, :3]
        assert first @ C[3:, 3:] @ first == pytest.approx(ANY_ANGLE, rel=1e-5)
        axis = np.cross(first, second)
        axis /= np.linalg.norm(axis)
        angle = np.arccos(first @ second)
        expected = seen.normal_sigma[k, 0] ** 2 + seen.probability[k, 1] * angle**2
        assert axis @ C[3:, 3:] @ axis == pytest.approx(expected, rel=1e-4)


def test_the_bridge_publishes_what_a_camera_locates():
    """Three messages for three roundels, on one topic of the camera."""
    endpoint, received = f"tcp/127.0.0.1:{free_port()}", Inbox()
    words = ["ros2", "--connect", endpoint, "--domain", "3", "--relative", "scout.1"]
    with open_router([endpoint]) as robot, open_client([endpoint]) as ros:
        ros.declare_subscriber("3/**", lambda sample: received.put(copy(sample)))
        key = Keys("arena").relative("scout.1")
        with running("fusion", *words, stdout=subprocess.DEVNULL):
            wait_for(lambda: len(received.items) >= 3, lambda: robot.put(key, encode(SENT)))
    names, payloads = zip(*received.items, strict=True)
    kind = RELATIVE.replace("/msg/", "::msg::dds_::") + "_"
    assert set(names) == {f"3/scout_1/relative/{kind}/{ROS.hash_rihs01(RELATIVE)}"}
    assert list(payloads[:3]) == relative_poses(SENT, "scout_1_optical_frame")


def copy(sample: zenoh.Sample) -> tuple[str, bytes]:
    return str(sample.key_expr), sample.payload.to_bytes()
