# SPDX-License-Identifier: BSD-3-Clause
"""From four unknown cameras on two machines to poses in a program, by two commands and clicks in a browser.

`python -m tests.benchmarks.first_arena [--pictures docs]` prints each sentence that the page shows on the way, for a
reader to judge, and how accurate the result is, and can save the pictures of the documentation. It needs Chromium,
iproute2 and the right to create network namespaces.
"""

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tyro
from playwright.sync_api import Page

from tests.benchmarks.faults.network import Namespaces, why_not
from tests.web.browser import CHROMIUM
from tests.web.roundel.first_arena import CAMERAS, CENTRE_M, PHASES, RADIUS_M, FirstArena, play, render

WIDTHS = {"cameras": 1600, "wand": 1600, "floor": 1100, "robots": 1100, "status": 420}
TABS = {
    "cameras": "Cameras",
    "wand": "Calibrate",
    "floor": "Calibrate",
    "robots": "Robots",
    "status": "Status",
}
JPEG_QUALITY = 85
HEIGHT = 1000
NO_NOTICE = ".mantine-Notifications-root { display: none }"  # that the browser renders in software
SETTLE_MS = 1500  # for the page to draw at its new width
# Each text of three words or more, once, whatever its numbers are.
NOTE_SENTENCES = r"""() => {
    const known = new Set();
    window.sentences = [];
    const note = root => {
        const texts = document.createTreeWalker(root, NodeFilter.SHOW_TEXT);
        for (let text = texts.currentNode; text; text = texts.nextNode()) {
            const sentence = text.nodeType === Node.TEXT_NODE ? text.data.trim() : "";
            const kind = sentence.replace(/[\d.]+/g, "#");
            if (sentence.split(" ").length > 2 && !text.parentElement?.closest("style") && !known.has(kind)) {
                known.add(kind);
                window.sentences.push(sentence);
            }
        }
    };
    note(document.body);
    const observer = new MutationObserver(changes => changes.forEach(change => note(change.target)));
    observer.observe(document.body, {subtree: true, childList: true, characterData: true});
}"""


def main(pictures: Path | None = None, recording: Path | None = None) -> None:
    """Print the duration of each step, and what the program receives.

    Args:
        recording: a folder for the rendered pictures, which an earlier run may have filled.
        pictures: a folder for pictures of the page at 1600, 1100 and 420 pixels, `page_STEP.jpg`.
    """
    if reason := "chromium is not installed" if CHROMIUM is None else why_not():
        sys.exit(f"this machine can't run the benchmark: {reason}")
    with tempfile.TemporaryDirectory(prefix="roundel-first-arena-") as temporary:
        folder = Path(temporary)
        recording = (recording or folder / "recording").resolve()  # its programs run in another folder
        render(recording)
        start = time.monotonic()

        def show(page: Page, step: str) -> None:
            if step == "begin":
                page.evaluate(NOTE_SENTENCES)
            for sentence in page.evaluate("window.sentences.splice(0)"):
                print(f"    {sentence}")
            print(f"{time.monotonic() - start:.0f} s: {step}", flush=True)
            if pictures is not None and step in WIDTHS:
                take_picture(page, step, pictures)

        with Namespaces([CAMERAS]) as network, FirstArena(network, recording, folder) as arena:
            outcome = play(arena, folder, show)
    circle = outcome.circle
    print(
        f"{outcome.calibration}\n"
        f"{outcome.clicks} clicks, of which {outcome.repeated} repeat a measurement, 2 commands, "
        f"{outcome.seconds:.0f} s from the page to {outcome.n_poses} poses of a robot that drives, of which the "
        f"script of the motions took {arena.times:.1f} times {sum(phase.seconds for phase in PHASES[:-1]):.0f} s to "
        f"its start\n"
        f"{outcome.n_poses} poses: radius {1e3 * circle.radius_m:.2f} of "
        f"{1e3 * RADIUS_M:.0f} mm, centre {1e3 * np.linalg.norm(circle.centre_m - CENTRE_M):.2f} mm off, "
        f"{1e3 * circle.rms_m:.2f} mm RMS from the circle, {circle.round_s:.3f} s a round"
    )


def take_picture(page: Page, step: str, folder: Path) -> None:
    """Save the page at the width of a step, then show it as before."""
    page.add_style_tag(content=NO_NOTICE)
    page.set_viewport_size({"width": WIDTHS[step], "height": HEIGHT})
    page.get_by_role("tab", name=TABS[step]).click()  # a narrow page begins with its first tab
    page.wait_for_timeout(SETTLE_MS)
    page.screenshot(path=folder / f"page_{step}.jpg", quality=JPEG_QUALITY)
    page.set_viewport_size({"width": WIDTHS["cameras"], "height": HEIGHT})


if __name__ == "__main__":
    tyro.cli(main)
