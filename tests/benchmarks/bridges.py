# SPDX-License-Identifier: BSD-3-Clause
"""Latency that a bridge adds, and its share of a core, with 50 robots at 60 Hz: `python -m tests.benchmarks.bridges`.

A process publishes poses by the server's own code. This process receives each pose twice: over Zenoh, and through the
bridge. The added latency is the difference of both times of arrival. Each bridge is a process of its own. Beside other
programs, run it with `chrt -r 1`: otherwise it measures their share of the processor.
"""

import contextlib
import socket
import statistics
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field

import msgspec
import psutil
import tyro
import zenoh

from camera_node.protocol.messages import Keys
from camera_node.protocol.session import open_client, open_router
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import RobotPose
from fusion.server.server import publish_poses
from fusion.server.server_clock import ServerClock
from fusion.server.transport import Transport
from tests.conftest import ROOT, free_port
from tests.fusion.bridges.foxglove_reader import FoxgloveClient
from tests.fusion.bridges.pose_server import ARENA, bridge, moving_pose
from tests.processes import first_line

ROBOTS, RATE_HZ, WARM_UP_S, CATCH_UP_S, LIMIT_MS, LIMIT_CORE = 50, 60, 3.0, 0.5, 2.0, 0.15
PUBLISH = "import sys; from tests.benchmarks.bridges import publish; publish(sys.argv[1])"


Times = dict[tuple[str, int], int]  # of arrival (ns), by robot and time in microseconds


@dataclass
class Arrivals:
    """When poses arrived; their times are in microseconds, because VRPN's have no finer ones."""

    times: Times = field(default_factory=dict)

    def put(self, robot: str, t_ns: int) -> None:
        self.times[robot, t_ns // 1000] = time.monotonic_ns()

    def put_all(self, poses: Sequence[RobotPose]) -> None:
        now_ns = time.monotonic_ns()
        self.times |= {(pose.robot, pose.t_ns // 1000): now_ns for pose in poses}


def publish(endpoint: str) -> None:
    """Publish all robots' poses in each frame set by the server's own code, until killed."""
    with open_router([endpoint]) as session, ExitStack() as closing:
        transport = Transport(session, ServerClock(), lambda reason, key: None, closing)
        poses = [moving_pose(f"robot{k:02}", 0, seed=k) for k in range(ROBOTS)]
        begun_ns, k = time.time_ns(), 0
        while True:
            k += 1
            t_ns = begun_ns + k * 1_000_000_000 // RATE_HZ
            stamped = [msgspec.structs.replace(pose, t_ns=t_ns) for pose in poses]
            time.sleep(max(0.0, (t_ns - time.time_ns()) * 1e-9))
            publish_poses(transport, Keys(ARENA), stamped, None)


@contextmanager
def read_vrpn(endpoint: str, arrivals: Arrivals) -> Iterator[int]:
    """Read poses through `fusion vrpn`; yields the bridge's process id."""
    port = free_port()
    with bridge("vrpn", "--connect", endpoint, "--port", str(port)) as process:
        first_line(process)
        connection = socket.create_connection(("127.0.0.1", port))
        connection.sendall(b"vrpn: ver. 07.35  0".ljust(24, b"\0"))
        reader = threading.Thread(target=_read_vrpn, args=(connection, arrivals), daemon=True)
        reader.start()
        yield process.pid
        connection.shutdown(socket.SHUT_RDWR)
        reader.join(5.0)


def _read_vrpn(connection: socket.socket, arrivals: Arrivals) -> None:
    names: dict[int, str] = {}
    with contextlib.suppress(OSError), connection, connection.makefile("rb") as file:
        file.read(24)
        while header := file.read(24):
            length, seconds, microseconds, sender, kind, _ = struct.unpack(">5iI", header)
            body = file.read(length - 24 + -length % 8)
            if kind == -1:
                names[sender] = body[4 : length - 24].rstrip(b"\0").decode()
            elif len(body) == struct.calcsize(">ii7d"):
                arrivals.put(names[sender], seconds * 10**9 + microseconds * 1000)


@contextmanager
def read_ros2(endpoint: str, arrivals: Arrivals) -> Iterator[int]:
    """Read `odometry` through `fusion ros2`."""

    def take(sample: zenoh.Sample) -> None:
        seconds, ns = struct.unpack_from("<II", sample.payload.to_bytes(), 4)
        arrivals.put(str(sample.key_expr).split("/")[1], seconds * 10**9 + ns)

    with bridge("ros2", "--connect", endpoint) as process, open_client([endpoint]) as session:
        session.declare_subscriber("0/*/odometry/**", take)
        yield process.pid


@contextmanager
def read_foxglove(endpoint: str, arrivals: Arrivals) -> Iterator[int]:
    """Read `/tf` through `fusion foxglove`."""
    with bridge("foxglove", "--connect", endpoint, "--port", "0") as process:
        port = int(first_line(process).rpartition(":")[2])
        done = threading.Event()

        def run() -> None:
            with FoxgloveClient(port, only="/tf") as client:
                while not done.is_set():
                    for transform in client.next("/tf")[2].transforms:
                        stamp = transform.timestamp
                        arrivals.put(transform.child_frame_id, stamp.seconds * 10**9 + stamp.nanos)

        reader = threading.Thread(target=run, daemon=True)
        reader.start()
        yield process.pid
        done.set()
        reader.join(5.0)


@contextmanager
def read_mavlink(endpoint: str, arrivals: Arrivals) -> Iterator[int]:
    """Read one robot of the fifty through `fusion mavlink`."""
    with socket.socket(type=socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        to = f"udp:127.0.0.1:{receiver.getsockname()[1]}"
        with bridge("mavlink", "robot00", "--connect", endpoint, "--to", to, "--rate-hz", "200") as process:
            done = threading.Event()

            def run() -> None:
                while not done.is_set():
                    data = receiver.recv(512)
                    if data[7:10] == (331).to_bytes(3, "little"):  # ODOMETRY; its first field is the time
                        arrivals.put("robot00", 1000 * struct.unpack_from("<Q", data, 10)[0])

            reader = threading.Thread(target=run, daemon=True)
            reader.start()
            yield process.pid
            done.set()
            reader.join(5.0)


BRIDGES: dict[str, Callable] = {
    "vrpn": read_vrpn,
    "ros2": read_ros2,
    "foxglove": read_foxglove,
    "mavlink": read_mavlink,
}


def measure(name: str, seconds: float) -> bool:
    """Measure one bridge and print its line; whether it is within the limits."""
    endpoint, direct, bridged = f"tcp/127.0.0.1:{free_port()}", Arrivals(), Arrivals()
    with ExitStack() as stack:
        server = subprocess.Popen([sys.executable, "-c", PUBLISH, endpoint], cwd=ROOT)
        stack.callback(server.wait)
        stack.callback(server.kill)
        client = stack.enter_context(Arena.connect(endpoint, arena=ARENA))
        client.pose_sets().on_message(direct.put_all)
        process = psutil.Process(stack.enter_context(BRIDGES[name](endpoint, bridged)))
        time.sleep(WARM_UP_S)
        direct.times.clear()
        used, begun_s = sum(process.cpu_times()[:2]), time.monotonic()
        time.sleep(seconds)
        core = (sum(process.cpu_times()[:2]) - used) / (time.monotonic() - begun_s)
        published = dict(direct.times)
        time.sleep(CATCH_UP_S)
        return report(name, published, dict(bridged.times), core)


def report(name: str, direct: Times, bridged: Times, core: float) -> bool:
    """Print a line; whether it is within the limits."""
    added = [(at - direct[key]) * 1e-6 for key, at in bridged.items() if key in direct]
    cuts = statistics.quantiles(added, n=100)
    robots = {robot for robot, _ in bridged}
    share = len(added) / max(1, sum(robot in robots for robot, _ in direct))
    print(f"{name:9} {len(added):7} {share:8.1%} {cuts[49]:9.2f} {cuts[98]:9.2f} {core:8.1%}", flush=True)
    return cuts[98] < LIMIT_MS and core < LIMIT_CORE


def main(bridges: tuple[str, ...] = tuple(BRIDGES), seconds: float = 10.0) -> None:
    """Measure bridges; exit code 1 if one is not within 2 ms (p99) and 15 % of a core.

    Args:
        bridges: their names.
        seconds: of each measurement.
    """
    print(f"{ROBOTS} robots at {RATE_HZ} Hz\nbridge      poses  arrived  p50 (ms)  p99 (ms)     core")
    sys.exit(not all([measure(name, seconds) for name in bridges]))


if __name__ == "__main__":
    tyro.cli(main)
