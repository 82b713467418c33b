# SPDX-License-Identifier: BSD-3-Clause
"""A robot's poses at an autopilot: pymavlink on its side of the UDP connection, frames from axes given by hand."""

import time

import msgspec
import numpy as np
import pytest

from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import rotation_from_vector, rotation_from_wxyz, wxyz_from_rotation
from fusion.bridges.mavlink_frames import FrdFrames, roll_pitch_yaw
from fusion.bridges.mavlink_vehicle import MavlinkVehicle, RateDivider, ResetCounter
from tests.fusion.bridges.autopilot import Autopilot
from tests.fusion.bridges.pose_server import PoseServer, bridge, moving_pose, restart
from tests.messages import STATUS
from tests.missing_package import advice_without
from tests.waiting import wait_for

ORIGIN, HEADING_DEG, FORWARD_DEG = (1.0, -2.0, 0.5), 30.0, 100.0
OPTIONS = ("--origin-m", "1", "-2", "0.5", "--heading-deg", "30", "--forward-deg", "100")
FLOAT32 = 3e-6  # absolute, of numbers up to 4: MAVLink sends float32, whose steps are 2.4e-7 there


def axes(degrees: float) -> np.ndarray:
    """(3, 3) rows: forward, right and down of a frame whose forward direction is so far from x towards y."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, s, 0], [s, -c, 0], [0, 0, -1]])


def test_odometry_is_the_pose_in_frd_frames_with_its_time_velocity_and_covariance(endpoint: str):
    with (
        PoseServer(endpoint, ahead_ns=5 * 10**9) as server,
        Autopilot() as autopilot,
        bridge(
            "mavlink", "rover", "--connect", endpoint, "--to", f"udp:127.0.0.1:{autopilot.port}", *OPTIONS
        ),
    ):
        messages = [autopilot.receive("ODOMETRY") for _ in range(20)]
        heartbeat = autopilot.receive("HEARTBEAT")
        published = [pose for (name, _), pose in list(server.published.items()) if name == "rover"]
    assert heartbeat.get_srcSystem() == messages[0].get_srcSystem() == 1
    assert messages[0].get_srcComponent() == 197  # MAV_COMP_ID_VISUAL_INERTIAL_ODOMETRY
    A, B = axes(HEADING_DEG), axes(FORWARD_DEG)
    for message in messages:
        (pose,) = [p for p in published if p.t_ns // 1000 == message.time_usec]
        R = rotation_from_wxyz(pose.quaternion_wxyz)
        assert (message.frame_id, message.child_frame_id) == (
            20,
            12,
        )  # MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD
        expected = A @ (np.array(pose.position) - ORIGIN)
        assert [message.x, message.y, message.z] == pytest.approx(expected, abs=FLOAT32)
        # the nose, the right side and the underside of the vehicle, in the local frame
        rotation = rotation_from_wxyz(message.q)
        assert rotation == pytest.approx(A @ R @ B.T, abs=FLOAT32)
        assert [message.vx, message.vy, message.vz] == pytest.approx(B @ R.T @ pose.velocity, abs=FLOAT32)
        rates = [message.rollspeed, message.pitchspeed, message.yawspeed]
        assert rates == pytest.approx(B @ R.T @ pose.angular_velocity, abs=FLOAT32)
        C = pose.covariance_matrix
        own = np.array(message.pose_covariance)[[0, 1, 2, 6, 7, 11]]
        position = (A @ C[3:6, 3:6] @ A.T)[np.triu_indices(3)]
        assert own == pytest.approx(position, rel=1e-5, abs=1e-6 * np.abs(position).max())


def test_vision_position_estimate_has_the_same_pose(endpoint: str):
    words = ("--connect", endpoint, "--message", "vision", *OPTIONS)
    with (
        PoseServer(endpoint) as server,
        Autopilot() as autopilot,
        bridge("mavlink", "rover", "--to", f"udp:127.0.0.1:{autopilot.port}", *words),
    ):
        message = autopilot.receive("VISION_POSITION_ESTIMATE")
        published = [pose for (name, _), pose in list(server.published.items()) if name == "rover"]
    (pose,) = [p for p in published if p.t_ns // 1000 == message.usec]
    expected = FrdFrames(ORIGIN, HEADING_DEG, FORWARD_DEG).convert(pose)
    assert [message.x, message.y, message.z] == pytest.approx(expected.position, abs=FLOAT32)
    about_x, about_y, about_z = (
        rotation_from_vector(a * np.eye(3)[k])
        for k, a in enumerate((message.roll, message.pitch, message.yaw))
    )
    assert about_z @ about_y @ about_x == pytest.approx(expected.rotation, abs=FLOAT32)


def test_the_servers_time_answers_timesync_and_poses_continue_after_a_restart(endpoint: str):
    """The autopilot's offset from the answer is the server's clock, 5 s ahead of this machine's."""
    with (
        PoseServer(endpoint, ahead_ns=5 * 10**9) as server,
        Autopilot() as autopilot,
        bridge("mavlink", "rover", "--connect", endpoint, "--to", f"udp:127.0.0.1:{autopilot.port}"),
    ):
        autopilot.receive("ODOMETRY")

        def is_synchronized() -> bool:
            sent_ns = time.monotonic_ns() - autopilot.begun_ns
            before_ns = server.now_ns()
            autopilot.link.mav.timesync_send(0, sent_ns)
            answer = autopilot.receive("TIMESYNC")
            assert answer.ts1 == sent_ns
            margin_ns = (
                20_000_000  # error of the bridge's own estimate on a loaded machine; 5 s are to be seen
            )
            return before_ns - margin_ns <= answer.tc1 <= server.now_ns() + margin_ns

        wait_for(is_synchronized)
        first = autopilot.receive("ODOMETRY").reset_counter
        since_us = restart(server) // 1000
        wait_for(lambda: autopilot.receive("ODOMETRY").time_usec > since_us)
        assert autopilot.receive("ODOMETRY").reset_counter in (
            first,
            first + 1,
        )  # 1 if it took more than a second


def test_roll_pitch_and_yaw_have_the_covariance_of_sampled_poses():
    """Small random errors of a pose, converted like the pose, have the converted covariance."""
    pose, frames, rng = (
        moving_pose("rover", 1_700_000_000_000_000_000, seed=5),
        FrdFrames(ORIGIN, 30.0, 100.0),
        None,
    )
    rng = np.random.default_rng(2)
    L, scale = np.linalg.cholesky(pose.covariance_matrix + 1e-12 * np.eye(12)), 1e-2
    converted, R = frames.convert(pose), rotation_from_wxyz(pose.quaternion_wxyz)
    centre = np.array(roll_pitch_yaw(converted.rotation))
    drawn = []
    for error in rng.normal(size=(4000, 12)) @ L.T * scale:
        disturbed = msgspec.structs.replace(
            pose,
            position=tuple((np.array(pose.position) + error[3:6]).tolist()),
            quaternion_wxyz=tuple(wxyz_from_rotation(R @ rotation_from_vector(error[:3])).tolist()),
        )
        other = frames.convert(disturbed)
        turn = np.array(roll_pitch_yaw(other.rotation)) - centre
        drawn.append([*(other.position - converted.position), *((turn + np.pi) % (2 * np.pi) - np.pi)])
    expected = converted.pose_covariance
    sd = np.sqrt(np.diag(expected))
    ratio = np.cov(np.transpose(drawn)) / scale**2 / np.outer(sd, sd)
    # correlations of 4000 draws have a standard deviation of at most sqrt(2 / 4000) = 0.022; five of them
    assert np.abs(ratio - expected / np.outer(sd, sd)).max() < 0.11


@pytest.mark.parametrize(
    ("input_hz", "rate_hz", "expected_hz"), [(60, 50, 50), (120, 50, 50), (30, 50, 30), (60, 30, 30)]
)
def test_the_rate_is_the_chosen_one_on_average(input_hz: int, rate_hz: int, expected_hz: int):
    divider = RateDivider(rate_hz)
    passed = sum(divider.passes(round(k * 1e9 / input_hz) + 10**18) for k in range(10 * input_hz))
    assert abs(passed - 10 * expected_hz) <= 1
    assert divider.passes(5 * 10**17)  # another server's time


def test_resets_count_losses_gaps_and_calibrations():
    counter, second = ResetCounter(), 10**9
    counter.add_loss()
    for k in (0, 1, 2):
        counter.add_pose(moving_pose("rover", k * second))
    assert counter.count == 0
    counter.add_pose(moving_pose("rover", 5 * second))
    assert counter.count == 1
    counter.add_loss()
    counter.add_loss()
    counter.add_pose(moving_pose("rover", 6 * second))
    assert counter.count == 2
    for rig_t_ns, expected in ((None, 2), (10, 2), (10, 2), (None, 2), (11, 3)):
        counter.add_status(msgspec.structs.replace(STATUS, rig_t_ns=rig_t_ns))
        assert counter.count == expected
    counter.count = 255
    counter.add_pose(moving_pose("rover", 9 * second))
    assert counter.count == 0


def test_bytes_that_are_not_mavlink_do_not_end_the_bridge():
    with Autopilot() as autopilot, MavlinkVehicle(f"udp:127.0.0.1:{autopilot.port}") as vehicle:
        vehicle.beat("ACTIVE")
        autopilot.receive("HEARTBEAT")
        rng = np.random.default_rng(1)
        for size in (1, 3, 12, 280, 2000):
            autopilot.link.write(b"\xfd" + rng.bytes(size))
        autopilot.link.mav.timesync_send(0, 7)

        def answered() -> bool:
            vehicle.answer(99)
            return (m := autopilot.link.recv_match(type="TIMESYNC")) is not None and (m.tc1, m.ts1) == (99, 7)

        # a length byte of the garbage may swallow what follows: the autopilot asks ten times a second
        wait_for(answered, lambda: autopilot.link.mav.timesync_send(0, 7))


@pytest.mark.parametrize(
    "to", ["192.168.4.1:14540", "udp:host", "udp:host:0", "udp:host:99999", "serial:/dev/ttyS0"]
)
def test_an_invalid_address_is_refused(to: str):
    with pytest.raises(ConfigError, match="give udp:HOST:PORT"):
        MavlinkVehicle(to)


def test_without_pymavlink_one_line_says_what_to_install():
    advice = advice_without("pymavlink", "fusion", "mavlink", "rover", "--to", "udp:127.0.0.1:9")
    assert "pip install 'roundel[mavlink]'" in advice
