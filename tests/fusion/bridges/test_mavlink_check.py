# SPDX-License-Identifier: BSD-3-Clause
"""What `roundel mavlink --check-s` says of an autopilot's own estimates."""

import re
import threading

import numpy as np
import pytest

from fusion.bridges.mavlink_check import AutopilotCheck, align
from fusion.bridges.mavlink_frames import FrdFrames, roll_pitch_yaw
from tests.fusion.bridges.autopilot import Autopilot
from tests.fusion.bridges.pose_server import PoseServer, moving_pose
from tests.processes import run_program
from tests.waiting import in_thread

TIMES_NS = np.arange(0, 10 * 10**9, 20_000_000)  # of poses of a robot that circles, climbs and turns


class Message:
    """A decoded message of an autopilot."""

    def __init__(self, kind: str, **fields: float) -> None:
        self.get_type = lambda: kind
        self.__dict__.update(fields)


def checked(
    sent: FrdFrames, own: FrdFrames, delay_s: float = 0.03, z: float = 1.0, scale: float = 1.0
) -> AutopilotCheck:
    """An autopilot whose true frame is `own`; z = -1 for one whose z points up; `scale` 0 for one that stands still."""
    check = AutopilotCheck()
    for t_ns in TIMES_NS.tolist():
        pose = moving_pose("rover", t_ns)
        check.add_sent(t_ns, sent.convert(pose))
        estimate, now_ns = own.convert(pose), t_ns + round(1e9 * delay_s)
        x, y, down = scale * estimate.position
        boot_ms, late_ns = now_ns // 10**6 - 5000, t_ns % 7 * 10**6  # its clock, and some messages are late
        place = Message("LOCAL_POSITION_NED", time_boot_ms=boot_ms, x=x, y=z * y, z=z * down)
        check.add_message(now_ns + late_ns, place)
        yaw = roll_pitch_yaw(estimate.rotation)[2]
        check.add_message(now_ns + late_ns, Message("ATTITUDE", time_boot_ms=boot_ms, yaw=yaw))
    return check


def test_an_autopilot_that_agrees_is_in_order():
    frames = FrdFrames((1.0, 2.0, 0.0), 30.0, 100.0)
    lines = list(checked(frames, frames).lines())
    assert [is_good for is_good, _ in lines] == [True] * 4
    assert "frames differ by +0 degrees" in lines[0][1] or "frames differ by -0 degrees" in lines[0][1]
    assert "30 ms behind" in lines[1][1]


@pytest.mark.parametrize(
    "angle", [-150.0, *(pytest.param(angle, marks=pytest.mark.ci) for angle in (40.0, 90.0))]
)
def test_the_advice_about_the_heading_cures_it(angle: float):
    sent, own = (FrdFrames((0.0, 0.0, 0.0), heading) for heading in (20.0, 20.0 + angle))
    text = next(text for is_good, text in checked(sent, own).lines() if not is_good and "frames" in text)
    advised = re.search(r"add ([+-]\d+) to it", text)
    assert advised is not None
    better = FrdFrames((0.0, 0.0, 0.0), 20.0 + float(advised[1]))
    assert all(is_good for is_good, _ in checked(better, own).lines())


@pytest.mark.ci
def test_a_nose_elsewhere_a_long_delay_and_an_upward_z_are_named():
    here = FrdFrames((0.0, 0.0, 0.0), 0.0, 0.0)
    nose = [text for good, text in checked(here, FrdFrames((0.0, 0.0, 0.0), 0.0, 90.0)).lines() if not good]
    assert len(nose) == 1
    assert "--forward-deg" in nose[0]
    late = [text for good, text in checked(here, here, delay_s=0.25).lines() if not good]
    assert len(late) == 1
    assert "250 ms behind" in late[0]
    up = [text for good, text in checked(here, here, z=-1.0).lines() if not good]
    assert len(up) == 1
    assert "z points up" in up[0]


def test_a_vehicle_at_rest_and_one_that_ignores_its_poses_are_not_compared():
    here = FrdFrames((0.0, 0.0, 0.0))
    ignoring = [text for good, text in checked(here, here, scale=0.0).lines() if not good]
    assert "its estimator does not use them" in ignoring[0]
    resting, pose = AutopilotCheck(), moving_pose("rover", 0)
    for t_ns in TIMES_NS.tolist():
        resting.add_sent(t_ns, here.convert(pose))
        resting.add_message(
            t_ns, Message("LOCAL_POSITION_NED", time_boot_ms=t_ns // 10**6, x=0.0, y=0.0, z=0.0)
        )
    assert any("hardly moved" in text for _, text in resting.lines())
    assert [good for good, _ in AutopilotCheck().lines()] == [False]


def test_positions_are_aligned_exactly():
    """Without noise, on a grid of delays that has the true one."""
    t = np.linspace(0, 10, 1001)
    sent = np.column_stack([t, np.cos(t), np.sin(2 * t), 0.3 * t])
    c, s = np.cos(0.7), np.sin(0.7)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    estimated = np.column_stack([t + 0.05, sent[:, 1:] @ R.T + [1.0, 2.0, 3.0]])
    found = align(sent, estimated)
    assert found is not None
    assert (found.delay_s, found.angle) == pytest.approx((0.05, 0.7), abs=1e-9)
    assert found.offset == pytest.approx([1.0, 2.0, 3.0], abs=1e-9)
    assert found.rms_m < 1e-9
    assert not found.is_mirrored


def test_the_command_compares_and_ends(endpoint: str):
    """An autopilot that believes each pose at once."""
    with PoseServer(endpoint), Autopilot() as autopilot:
        ended = threading.Event()

        def fly() -> None:
            while not ended.is_set():
                message = autopilot.link.recv_match(type="ODOMETRY", blocking=True, timeout=0.2)
                if message is not None:
                    send, ms = autopilot.link.mav, message.time_usec // 1000 % 2**32
                    send.local_position_ned_send(ms, message.x, message.y, message.z, 0, 0, 0)
                    w, x, y, z = message.q
                    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
                    send.attitude_send(ms, 0, 0, float(yaw), 0, 0, 0)

        to = f"udp:127.0.0.1:{autopilot.port}"
        words = ("--connect", endpoint, "--arena", "test", "--to", to, "--check-s", "5")
        with in_thread(fly, ended.set):
            program = run_program("fusion", "mavlink", "rover", *words)
    assert re.search(r"ok +frames differ by [+-]0 degrees", program.stdout), program.stdout + program.stderr
    assert re.search(r"ok +yaw differs by [+-]0 degrees", program.stdout)
