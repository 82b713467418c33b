# SPDX-License-Identifier: BSD-3-Clause
"""Robots as VRPN trackers, read by libmotioncapture (VRPN's C++ client) and by a client after VRPN's source.

libmotioncapture shows neither times nor velocities; `VrpnReader` does, and it sees every message.
"""

import contextlib
import json
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from camera_node.geometry.pose import rotation_from_vector, rotation_from_wxyz
from fusion.bridges.vrpn_messages import VELOCITY_S, turn
from fusion.bridges.vrpn_server import MAX_OF_ADDRESS
from tests.conftest import ROOT
from tests.fusion.bridges.pose_server import PoseServer, restart
from tests.fusion.bridges.vrpn_reader import VrpnReader, serving
from tests.processes import killed_at_end, run_program
from tests.waiting import DEADLINE_S, wait_for

FLOAT32 = 1e-6  # relative; libmotioncapture converts to float32, whose steps are 1.2e-7
MICROSECOND_NS = 1000


@contextlib.contextmanager
def motion_capture(host: str) -> Iterator[Iterator[dict[str, list[float]]]]:
    """The frames that libmotioncapture receives."""
    words = [sys.executable, "-m", "tests.fusion.bridges.motioncapture_client", host]
    with killed_at_end(words, cwd=ROOT, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        # VRPN's notes are on stdout, too
        yield (json.loads(line) for line in process.stdout if line.startswith("{"))


@pytest.mark.parametrize(
    "scheme", ["tcp://", pytest.param("", marks=pytest.mark.ci)]
)  # the latter asks by UDP for a connection, and reports come by UDP
def test_vrpns_own_client_reads_the_robots(endpoint: str, scheme: str):
    with (
        PoseServer(endpoint) as server,
        serving(endpoint) as port,
        motion_capture(f"{scheme}127.0.0.1:{port}") as frames,
    ):
        received = [
            (name, row) for _, frame in zip(range(30), frames, strict=False) for name, row in frame.items()
        ]
        published = list(server.published.values())
    assert {name for name, _ in received} == {"rover", "drone"}
    for name in ("rover", "drone"):
        sent = np.array([(*p.position, *p.quaternion_wxyz) for p in published if p.robot == name])
        rows = np.array([row for other, row in received if other == name])
        distance = np.abs(rows[:, None] - sent[None]).max(axis=2).min(axis=1)
        assert distance.max() < FLOAT32 * np.abs(sent).max()
        assert len(np.unique(rows, axis=0)) >= 15  # they move


@pytest.mark.parametrize("udp", [pytest.param(False, marks=pytest.mark.ci), True])
def test_every_pose_arrives_once_with_its_time_and_velocity(endpoint: str, udp: bool):
    times: dict[str, list[int]] = {"rover": [], "drone": []}
    with PoseServer(endpoint) as server, serving(endpoint) as port, VrpnReader(port, udp) as reader:
        reader.await_names(2)
        messages = []
        while len(messages) < 200:
            messages += reader.datagram() if udp else [reader.next()]
        published = dict(server.published)
    for sender, kind, t_ns, body in messages:
        # VRPN's times have microseconds
        pose = next(
            p for (name, t), p in published.items() if name == sender and 0 <= t - t_ns < MICROSECOND_NS
        )
        w, x, y, z = pose.quaternion_wxyz
        if kind == "vrpn_Tracker Pos_Quat":
            assert struct.unpack(">ii7d", body) == (0, 0, *pose.position, x, y, z, w)
            times[sender].append(t_ns)
        else:
            assert kind == "vrpn_Tracker Velocity"
            sensor, _, *v, qx, qy, qz, qw, dt = struct.unpack(">ii8d", body)
            assert (sensor, tuple(v)) == (0, pose.velocity)
            R = rotation_from_wxyz((qw, qx, qy, qz))
            assert rotation_from_vector(np.array(pose.angular_velocity) * dt) == pytest.approx(R, abs=1e-12)
    for name, seen in times.items():  # rates are equal: no pose between the first and the last is missing
        sent = [
            t // 1000 * 1000
            for other, t in published
            if other == name and seen[0] <= t // 1000 * 1000 <= seen[-1]
        ]
        assert seen == sent


def test_a_ping_is_answered_in_the_trackers_name(endpoint: str):
    with PoseServer(endpoint), serving(endpoint) as port, VrpnReader(port) as reader:
        while reader.next()[0] != "drone":
            pass
        for kind, number, name in ((-1, 7, b"drone\0"), (-2, 5, b"vrpn_Base ping_message\0")):
            reader.send(kind, number, struct.pack(">i", len(name)) + name)
        reader.send(5, 7, b"")
        while (message := reader.next())[1] != "vrpn_Base pong_message":
            pass
    assert message[0] == "drone"


def test_clients_stay_connected_while_the_server_restarts(endpoint: str):
    with PoseServer(endpoint) as server, serving(endpoint) as port, VrpnReader(port) as reader:
        reader.next()
        since_ns = restart(server)
        while reader.next()[2] <= since_ns:
            pass


def test_hostile_clients_do_not_end_the_bridge(endpoint: str):
    hostile = (
        b"GET / HTTP/1.1\r\nHost: vrpn\r\n\r\n",
        b"vrpn: ver. 07.35  0\0\0\0\0\0" + struct.pack(">6i", 2**31 - 1, 0, 0, 0, -1, 0),
        b"vrpn: ver. 07.35  0\0\0\0\0\0" + struct.pack(">6i", -8, 0, 0, 0, -1, 0),
        b"vrpn: ver. 07.35  0\0\0\0\0\0" + struct.pack(">6ii", 28, 0, 0, 0, -1, 0, 2**31 - 1) + bytes(4),
    )
    with PoseServer(endpoint), serving(endpoint) as port:
        for data in hostile:
            with socket.create_connection(("127.0.0.1", port), DEADLINE_S) as connection:
                connection.sendall(data)
                with contextlib.suppress(ConnectionResetError):
                    while connection.recv(4096):
                        pass
        with socket.socket(type=socket.SOCK_DGRAM) as datagrams:
            for data in (b"", b"\xff" * 500, b"127.0.0.1 99999\0", b"127.0.0.1 0\0", b"127.0.0.1 1\0"):
                datagrams.sendto(data, ("127.0.0.1", port))
        with VrpnReader(port) as reader:
            assert reader.next()[0] in ("rover", "drone")


@pytest.mark.parametrize("command", ["vrpn", "foxglove"])
def test_a_port_in_use_is_reported_in_one_line(command: str):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        program = run_program("fusion", command, "--port", port)
    assert program.returncode == 75
    assert len(program.stderr.splitlines()) == 1
    assert f"can't listen on 127.0.0.1 port {port}" in program.stderr


def test_a_turn_is_a_unit_quaternion_at_any_speed():
    for speed in (0.0, 1e-12, 1.0, np.pi / VELOCITY_S, 1e5):
        assert np.linalg.norm(turn((speed, 0.0, 0.0))) == pytest.approx(1.0, abs=1e-12)
    assert turn((0.0, 0.0, 0.0)) == (0.0, 0.0, 0.0, 1.0)


def test_a_client_that_never_reads_is_dropped(endpoint: str):
    """What waits for it is bounded, also the answers to its pings, and others are served."""
    with (
        PoseServer(endpoint),
        serving(endpoint) as port,
        VrpnReader(port) as deaf,
        VrpnReader(port) as reader,
    ):
        for kind, number, name in ((-1, 7, b"drone\0"), (-2, 5, b"vrpn_Base ping_message\0")):
            deaf.send(kind, number, struct.pack(">i", len(name)) + name)
        deaf.connection.settimeout(DEADLINE_S)

        def ping() -> bool:
            with contextlib.suppress(ConnectionError):
                for _ in range(1000):
                    deaf.send(5, 7, b"")
                return False
            return True

        wait_for(ping)
        assert reader.next()[0] in ("rover", "drone")


def test_one_machine_has_a_bounded_number_of_clients(endpoint: str):
    with PoseServer(endpoint), serving(endpoint) as port, contextlib.ExitStack() as stack:
        for _ in range(MAX_OF_ADDRESS):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), DEADLINE_S, ("127.0.0.2", 0)))
        excess = stack.enter_context(
            socket.create_connection(("127.0.0.1", port), DEADLINE_S, ("127.0.0.2", 0))
        )
        with contextlib.suppress(ConnectionResetError):
            assert excess.recv(1) == b""
        assert stack.enter_context(VrpnReader(port)).next()[0] in ("rover", "drone")
