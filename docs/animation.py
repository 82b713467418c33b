# SPDX-License-Identifier: BSD-3-Clause
"""Creates docs/demo.webp: `.venv/bin/python docs/animation.py` records the demo and films its page in Chromium.

The page shows the recording step by step, so the film does not depend on the speed of this machine. A recording that
exists is filmed without running the demo: `docs/animation.py demo.mcap`.
"""

import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Page, sync_playwright

from calib.rig.rig_messages import RigMessage
from camera_node.protocol.messages import decode
from tests.web.browser import FLAGS, loopback
from web.page import add_replay_page
from web.state.feed import DemoProgress, Feed
from web.state.recording_player import RecordingPlayer
from web.view import SLOW_INTERVAL, View

OUT = Path(__file__).with_name("demo.webp")
PAGE_WIDTH, PAGE_HEIGHT = 1100, 620  # pixels
WIDTH = 960  # of the film
TRACKED_S = 14.0
WAND_STEP_S, ROBOT_STEP_S = 0.6, 0.125
FILMED_S = 9.0  # of the robots
FRAME_MS = 125
FEED_MS, DRAW_MS = (
    50,
    350,
)  # for the feed to take a step, and for the browser to draw it with software rendering
NEXT_DRAWING = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
MAX_TRIES = 8
SAME = 0.02  # mean difference of grey levels, below which nothing has moved
QUALITY = 75


def main() -> None:
    """Record, film and write."""
    with tempfile.TemporaryDirectory() as folder:
        recording = Path(sys.argv[1]) if len(sys.argv) > 1 else record(Path(folder) / "demo.mcap")
        frames = list(film(RecordingPlayer(recording)))
    write(frames, OUT)
    print(f"{OUT}: {len(frames)} frames, {OUT.stat().st_size / 1e6:.2f} MB")


def record(path: Path) -> Path:
    """Run the demo and record it."""
    demo = [sys.executable, "-m", "web", "--demo", "--headless", "--seconds", str(TRACKED_S)]
    with subprocess.Popen(demo, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        endpoint = next(line.split()[-1] for line in process.stdout if line.startswith("Zenoh endpoint"))
        words = [sys.executable, "-m", "fusion", "record", path, "--connect", endpoint, "--arena", "demo"]
        recorder = subprocess.Popen(words)
        print(process.stdout.read(), end="")
        recorder.terminate()
        recorder.wait(30.0)
    return path


def steps(player: RecordingPlayer) -> Iterator[float]:
    """The times to film, seconds of the recording: the wand in large steps, then the robots."""
    shares, rigs = [], []
    for seconds, key, data in player.messages(0.0):
        if key.endswith("/demo/progress"):
            shares.append((seconds, decode(data, DemoProgress).share))
        elif key.endswith("/rig") and decode(data, RigMessage).rig.placed():
            rigs.append(seconds)
    wand = [seconds for seconds, share in shares if 0.0 < share < 1.0]
    yield from np.arange(wand[0], wand[-1], WAND_STEP_S)
    yield from np.arange(rigs[-1], rigs[-1] + 0.3 + FILMED_S, ROBOT_STEP_S)


def film(player: RecordingPlayer) -> Iterator[np.ndarray]:
    """Show a recording in the page, and yield a picture of each step."""
    feed, stop = Feed(player.arena, clock=player.seconds), threading.Event()
    access = loopback()
    view = View(feed, access)
    add_replay_page(view, player)
    times = list(steps(player))
    player.play(False)
    player.seek(times[0])
    thread = threading.Thread(target=player.run, args=(feed, stop))
    thread.start()
    try:
        with sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS)
            page = browser.new_page(viewport={"width": PAGE_WIDTH, "height": PAGE_HEIGHT})
            open_page(page, f"http://{access.host}:{access.port}")
            last = picture(page)
            for before, now in zip([times[0], *times], times, strict=False):
                for _ in range(SLOW_INTERVAL):  # one of these drawings extends the trails
                    player.step((now - before) / SLOW_INTERVAL)
                    page.wait_for_timeout(FEED_MS)
                    view.update()
                last = drawn(page, last)
                yield last
            browser.close()
    finally:
        stop.set()
        thread.join()
        view.close()


def open_page(page: Page, address: str) -> None:
    """Wait for the page, and close the notification about software rendering."""
    page.goto(address)
    page.get_by_text("Software WebGL").wait_for(timeout=120_000)
    page.locator(".mantine-Notification-closeButton").first.click()


def drawn(page: Page, last: np.ndarray) -> np.ndarray:
    """The picture of the next step, which differs from the last one once the browser has drawn it."""
    image = last
    for _ in range(MAX_TRIES):
        page.wait_for_timeout(DRAW_MS)
        page.evaluate(NEXT_DRAWING)
        image = picture(page)
        if np.abs(image.astype(int) - last).mean() > SAME:
            break
    return image


def picture(page: Page) -> np.ndarray:
    """The page, reduced to the size of the film."""
    image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return cv2.resize(image, (WIDTH, WIDTH * PAGE_HEIGHT // PAGE_WIDTH), interpolation=cv2.INTER_AREA)


def write(frames: list[np.ndarray], path: Path) -> None:
    """Write an animated WebP that repeats."""
    animation = cv2.Animation()
    animation.frames = frames
    animation.durations = [FRAME_MS] * len(frames)
    cv2.imwriteanimation(str(path), animation, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])


if __name__ == "__main__":
    main()
