# SPDX-License-Identifier: BSD-3-Clause
"""Measures the page's process before a large arena: `python -m tests.benchmarks.page`.

Eight cameras with 60 frames/s and pictures, 50 robots and 200 markers with 60 poses/s; two clients on the page, one of
which stops reading. The limit is 30 % of a core.
"""

import subprocess
import sys
import threading
import time

import cv2
import numpy as np
import psutil
import viser
from websockets.sync.client import ClientConnection, connect

from camera_node.protocol.messages import Preview, encode
from tests.conftest import free_port
from tests.waiting import wait_for_port
from tests.web.arena import LiveArena

SECONDS, RATE_HZ = 20.0, 60.0
N_CAMERAS, N_ROBOTS, N_MARKERS = 8, 50, 200
LIMIT = 0.30  # of a core


def speak(arena: LiveArena, stop: threading.Event, sent: list[int]) -> None:
    """Send what such an arena publishes, until `stop` is set; `sent` gets one entry for each frame set."""
    rng, k = np.random.default_rng(0), 0
    names = tuple(f"cam{n}" for n in range(N_CAMERAS))
    noise = rng.integers(60, 120, (200, 320), np.uint8)
    jpeg = cv2.imencode(".jpg", noise, [cv2.IMWRITE_JPEG_QUALITY, 60])[1].tobytes()
    places = rng.uniform(-3, 3, (N_MARKERS, 3))
    while not stop.wait(1 / RATE_HZ):
        for n in range(N_ROBOTS):
            x, y = places[n, 0] + np.sin(k / 60), places[n, 1] + np.cos(k / 60)
            arena.pose(f"robot_{n}", (float(x), float(y), 0.1))
        arena.markers([tuple(place) for place in places.tolist()])
        for name in names:
            arena.detections(name, [(100.0 * n % 640, 50.0) for n in range(25)])
        if k % round(RATE_HZ / 3) == 0:
            for name in names:
                preview = Preview(camera=name, t_ns=time.time_ns(), width=640, height=400, jpeg=jpeg)
                arena.put(arena.keys.preview(name), encode(preview))
        if k % round(RATE_HZ) == 0:
            for name in names:
                arena.camera(name)
            arena.status(names)
        sent.append(k)
        k += 1


def open_page(port: int) -> ClientConnection:
    return connect(
        f"ws://127.0.0.1:{port}",
        subprotocols=[f"viser-v{viser.__version__}"],  # pyright: ignore[reportArgumentType]
        max_size=None,
        compression=None,
    )


def read(client: ClientConnection, received: list[int]) -> None:
    for message in client:
        received.append(len(message))


def cpu_share(process: psutil.Process, seconds: float) -> float:
    """Share of a core that a process uses during some seconds."""
    before, begun = sum(process.cpu_times()[:2]), time.monotonic()
    time.sleep(seconds)
    return (sum(process.cpu_times()[:2]) - before) / (time.monotonic() - begun)


def main() -> int:
    arena, stop, port = LiveArena(), threading.Event(), free_port()
    sent: list[int] = []
    speaker = threading.Thread(target=speak, args=(arena, stop, sent))
    speaker.start()
    command = [
        sys.executable,
        "-m",
        "web",
        "--connect",
        arena.endpoint,
        "--arena",
        "test",
        "--port",
        str(port),
    ]
    page = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        wait_for_port(port)
        process, received = psutil.Process(page.pid), []
        shares = {"no browser": cpu_share(process, SECONDS / 2)}
        with open_page(port) as reader:
            threading.Thread(target=read, args=(reader, received), daemon=True).start()
            n_sent, memory = len(sent), process.memory_info().rss
            shares["one browser"] = cpu_share(process, SECONDS)
            print(
                f"memory with one browser: {(process.memory_info().rss - memory) / 1e6:+.1f} MB in {SECONDS:.0f} s"
            )
            print(f"frame sets/s that were sent (of {RATE_HZ:.0f}): {(len(sent) - n_sent) / SECONDS:.0f}")
            rate = len(received) / SECONDS
            with open_page(port):  # reads nothing
                count, memory = len(received), process.memory_info().rss
                shares["one browser, and one that stopped reading"] = cpu_share(process, SECONDS)
                grown_mb = (process.memory_info().rss - memory) / 1e6
            print(
                f"messages/s to the reader: {rate:.1f}, beside the other {(len(received) - count) / SECONDS:.1f}"
            )
            print(f"memory beside the one that stopped reading: {grown_mb:+.0f} MB in {SECONDS:.0f} s")
    finally:
        stop.set()
        speaker.join()
        page.terminate()
        page.wait()
        arena.session.close()
    for name, share in shares.items():
        print(f"{name}: {100 * share:.0f} % of a core")
    return int(max(shares.values()) > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
