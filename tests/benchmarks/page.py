# SPDX-License-Identifier: BSD-3-Clause
"""Measures the page beside a live server: `python -m tests.benchmarks.page [--rounds 2] [--seconds 10] [--hz 60]`.

Eight cameras with 60 frames/s and pictures, 50 robots and 200 markers. The page's process may use 30 % of a core, and
the server's latency must be the same without a page, with a page, with three browsers and beside one that stopped
reading. The conditions alternate; ratios are to the smaller one of two measurements without a page, and the larger one
shows what the machine alone changes. Each browser is a process that reads the page's messages as Viser's client does,
without drawing them: on two cores, drawing would take the time that the server needs.
"""

import multiprocessing
import os
import signal
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import msgspec
import numpy as np
import psutil
import tyro
import viser
import zenoh
from websockets.sync.client import connect

from camera_node.protocol.messages import Keys, Preview, decode, encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena
from fusion.protocol.pose_messages import RobotPoses
from tests.benchmarks.fusion_load import LENS, Load
from tests.benchmarks.fusion_server import ARENA, DEADLINE_S, publish, serving
from tests.conftest import free_port
from tests.messages import NODE
from tests.waiting import in_thread, wait_for, wait_for_port

LIMIT = 0.30  # of a core
PICTURES_HZ = 3
SETTLE_S = 2.0  # after a page or a browser was opened
WARM_UP_S = 20.0  # for all robots to be acquired
CONDITIONS = (
    "no page",
    "page",
    "one browser",
    "three browsers",
    "three, one stopped reading",
    "no page again",  # shows how much the machine alone changes
)
N_BROWSERS = {"one browser": 1, "three browsers": 3, "three, one stopped reading": 3}


def main(rounds: int = 2, seconds: float = 10.0, hz: float = 60.0) -> int:
    """Print the page's processor time and memory, and the server's latency in each condition; 1 beyond the limit.

    Args:
        rounds: of all conditions.
        seconds: of each condition.
        hz: of each camera.
    """
    load, endpoint = Load(hz=hz, speed_m_s=0.5), f"tcp/127.0.0.1:{free_port()}"
    shares: dict[str, list[float]] = {name: [] for name in CONDITIONS}
    ratios: dict[str, list[float]] = {name: [] for name in CONDITIONS}
    with TemporaryDirectory() as folder, serving(load, Path(folder), endpoint):
        with Arena.connect(endpoint, arena=ARENA) as arena:
            arena.status(DEADLINE_S).next(DEADLINE_S)  # the server runs
        with open_client([endpoint]) as session, sending(load, session):
            latencies = Latencies(session)
            wait_for(lambda: latencies.n_tracked >= 0.9 * load.robots)
            latencies.measure(WARM_UP_S)
            for _ in range(rounds):
                medians: dict[str, float] = {}
                for name in CONDITIONS:
                    with condition(name, endpoint) as page:
                        before = cpu_s(page)
                        values = latencies.measure(seconds)
                        share = (cpu_s(page) - before) / seconds
                        memory = page.memory_info().rss / 1e6 if page else 0.0
                    median, worst = statistics.median(values), float(np.percentile(values, 99))
                    medians[name] = median
                    if page:
                        shares[name].append(share)
                    own = f"; page {share:.0%} of a core, {memory:.0f} MB" if page else ""
                    figures = f"{median:.2f} ms p50, {worst:.1f} ms p99, {len(values) / seconds:.0f} sets/s"
                    print(f"{name}: latency {figures}{own}", flush=True)
                base = min(medians["no page"], medians["no page again"])
                for name, median in medians.items():
                    ratios[name].append(median / base)
    for name, values in ratios.items():
        own = f"; page {statistics.median(shares[name]):.0%} of a core" if shares[name] else ""
        print(f"{name}: latency {statistics.median(values):.2f} times that without a page{own}")
    return int(max(statistics.median(values) for values in shares.values() if values) > LIMIT)


class Latencies:
    """From the middle of the newest exposure until a client has the poses of all robots, milliseconds."""

    def __init__(self, session: zenoh.Session) -> None:
        self._values: list[float] = []
        self.n_tracked = 0
        self._subscriber = session.declare_subscriber(Keys(ARENA).poses, self._receive)

    def _receive(self, sample: zenoh.Sample) -> None:
        now_ns = time.time_ns()
        poses = decode(sample.payload.to_bytes(), RobotPoses).poses
        self.n_tracked = sum(pose.state == "tracked" for pose in poses)
        self._values.append((now_ns - poses[0].t_ns) / 1e6)

    def measure(self, seconds: float) -> list[float]:
        """Those of the next seconds."""
        start = len(self._values)
        threading.Event().wait(seconds)
        if len(self._values) == start:
            sys.exit(f"no poses in {seconds:g} s: this machine is too slow for this rate; give a lower --hz")
        return self._values[start:]


@contextmanager
def condition(name: str, endpoint: str) -> Iterator[psutil.Process | None]:
    """The page, and its browsers, of a condition; None without a page."""
    with ExitStack() as stack:
        page = None
        if "no page" not in name:
            page, port = stack.enter_context(open_page(endpoint))
            browsers = [stack.enter_context(browser(port)) for _ in range(N_BROWSERS.get(name, 0))]
            if "stopped" in name:
                os.kill(browsers[-1], signal.SIGSTOP)
        threading.Event().wait(SETTLE_S)
        yield page


@contextmanager
def open_page(endpoint: str) -> Iterator[tuple[psutil.Process, int]]:
    """A page of the arena, and its port."""
    port = free_port()
    words = ("-m", "web", "--connect", endpoint, "--arena", ARENA, "--port", str(port))
    page = subprocess.Popen([sys.executable, *words], stdout=subprocess.DEVNULL)
    try:
        wait_for_port(port)
        yield psutil.Process(page.pid), port
    finally:
        page.terminate()
        page.wait(DEADLINE_S)


@contextmanager
def browser(port: int) -> Iterator[int]:
    """A process that reads the page; yields its id as soon as the first message arrived."""
    context = multiprocessing.get_context("spawn")
    reads = context.Event()
    process = context.Process(target=read, args=(port, reads), daemon=True)
    process.start()
    assert process.pid is not None
    try:
        assert reads.wait(DEADLINE_S), "the page sent nothing"
        yield process.pid
    finally:
        process.kill()
        process.join(DEADLINE_S)


def read(port: int, reads: "multiprocessing.synchronize.Event") -> None:  # pyright: ignore[reportAttributeAccessIssue]
    """Read all messages of the page."""
    protocol = [f"viser-v{viser.__version__}"]
    with connect(f"ws://127.0.0.1:{port}", subprotocols=protocol, max_size=None, compression=None) as client:  # pyright: ignore[reportArgumentType]
        for _ in client:
            reads.set()


@contextmanager
def sending(load: Load, session: zenoh.Session) -> Iterator[None]:
    """Publish the detections of the load, pictures and the cameras' states."""
    stop = threading.Event()

    def send() -> None:
        pictures = picture_messages(load)
        due = 0.0
        for sent_s in publish(load, session, 1e6):
            if stop.is_set():
                return
            if sent_s >= due:
                due += 1 / PICTURES_HZ
                for key, data in pictures:
                    session.put(key, data)

    with in_thread(send, stop.set):
        yield


def picture_messages(load: Load) -> list[tuple[str, bytes]]:
    """Key and bytes of a picture and a status of each camera."""
    keys, noise = Keys(ARENA), np.random.default_rng(0).integers(60, 120, (200, 320), np.uint8)
    jpeg = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 60])[1].tobytes()
    width, height = int(LENS["width"]), int(LENS["height"])
    messages = []
    for name in load.rig:
        preview = Preview(camera=name, t_ns=time.time_ns(), width=width, height=height, jpeg=jpeg)
        status = msgspec.structs.replace(NODE, camera=name, t_ns=time.time_ns(), width=width, height=height)
        messages += [(keys.preview(name), encode(preview)), (keys.camera_status(name), encode(status))]
    return messages


def cpu_s(process: psutil.Process | None) -> float:
    """Processor time of a process so far."""
    return sum(process.cpu_times()[:2]) if process else 0.0


if __name__ == "__main__":
    sys.exit(tyro.cli(main))
