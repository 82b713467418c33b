# SPDX-License-Identifier: BSD-3-Clause
"""Memory of the live server over time: `python -m tests.benchmarks.fusion_server [--minutes 10]`.

`python -m fusion` runs as a separate process and receives detections over Zenoh on loopback in real time.
"""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np
import tyro
import zenoh

from calib.rig.rig import Rig, save_rig
from camera_node.protocol.messages import Detections, Keys, encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena, Stream
from fusion.model.robots import save_robots
from fusion.protocol.pose_messages import FusionStatus
from tests.benchmarks.fusion_load import START_NS, Load
from tests.conftest import free_port
from tests.processes import running

ARENA = "load"
DEADLINE_S = 60.0
SCENE_S = 10.0  # after which all robots are where they began
DELAY_NS = 5_000_000  # from an exposure until its detections are sent


def main(minutes: float = 10.0, robots: int = 20, cameras: int = 4, hz: float = 30.0) -> None:
    """Print the server's status at the end of each minute, and the growth of its memory per minute.

    Args:
        minutes: of real time.
        robots: of 4 markers each; a tenth of the detections is missing, each frame has a false one, 5 markers are
            unlabeled.
        cameras: free-running.
        hz: of each camera.
    """
    load = Load(robots=robots, cameras=cameras, hz=hz, clutter=5, period_s=SCENE_S)
    endpoint, minute, memory = f"tcp/127.0.0.1:{free_port()}", 1, []
    with (
        TemporaryDirectory() as folder,
        serving(load, Path(folder), endpoint),
        Arena.connect(endpoint, arena=ARENA) as arena,
        open_client([endpoint], timeout_s=DEADLINE_S) as session,
    ):
        status = arena.status(DEADLINE_S)
        status.next(DEADLINE_S)
        for sent_s in publish(load, session, 60 * minutes):
            if sent_s >= 60 * minute:
                memory.append(print_status(minute, status, load))
                minute += 1
    steady = memory[1:]  # caches are filled in the first minute
    if len(steady) > 1:
        print(
            f"{np.polyfit(np.arange(len(steady)), steady, 1)[0]:.3f} MB a minute after the first; goal: flat, 0.1 MB"
        )


@contextmanager
def serving(load: Load, folder: Path, endpoint: str) -> Iterator[None]:
    """A server with the load's rig and robots."""
    save_rig(Rig(cameras=load.rig), folder / "rig.yaml")
    save_robots(load.bodies, folder / "robots.yaml")
    files = ["--rig", folder / "rig.yaml", "--robots", folder / "robots.yaml"]
    with running("fusion", "--arena", ARENA, "--listen", endpoint, *files):
        yield


def publish(load: Load, session: zenoh.Session, seconds: float) -> Iterator[float]:
    """Publish all detections in real time; yield the seconds since the start after each."""
    keys, pause = Keys(ARENA), threading.Event()
    publishers = {name: session.declare_publisher(keys.detections(name)) for name in load.rig}
    scene, begun_ns = list(load.messages(SCENE_S)), time.time_ns()
    for seq, (message, after_ns) in enumerate(repeated(scene)):
        t_ns = begun_ns + after_ns
        pause.wait(max(t_ns + DELAY_NS - time.time_ns(), 0) * 1e-9)
        now = msgspec.structs.replace(message, seq=seq, t_ns=t_ns, sent_ns=time.time_ns())
        publishers[message.camera].put(encode(now))
        yield after_ns * 1e-9
        if after_ns > seconds * 1e9:
            return


def repeated(scene: list[Detections]) -> Iterator[tuple[Detections, int]]:
    """A scene's detections again and again, and their times since the start: new ones would take too long to make."""
    for turn in count():
        for message in scene:
            yield message, round(turn * SCENE_S * 1e9) + message.t_ns - START_NS


def print_status(minute: int, stream: Stream[FusionStatus], load: Load) -> float:
    """Print the server's last status; return its memory in MB."""
    status = stream.latest()
    assert status is not None
    tracked = sum(state == "tracked" for state in status.robots.values()) / load.robots
    figures = (
        f"{status.memory_mb:.2f} MB, {status.cpu:.0%} of a core, {status.frame_sets_per_s:.1f} poses a second"
    )
    print(f"{minute:3d} min: {figures}, {tracked:.0%} tracked, faults {status.faults or 'none'}", flush=True)
    return status.memory_mb


if __name__ == "__main__":
    tyro.cli(main)
