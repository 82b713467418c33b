# SPDX-License-Identifier: BSD-3-Clause
"""From four unknown cameras on two machines to poses in a program, by two commands and clicks in a browser.

`python -m tests.benchmarks.first_arena [--pictures docs]` prints how accurate the result is, and can save the pictures
of the documentation. It needs Chromium, iproute2 and the right to create network namespaces.
"""

import sys
import tempfile
import time
from pathlib import Path

import tyro
from playwright.sync_api import Page

from tests.benchmarks.faults.network import Namespaces, why_not
from tests.web.browser import CHROMIUM
from tests.web.roundel.first_arena import CAMERAS, RADIUS_M, FirstArena, play, render

WIDTHS = {"cameras": 1600, "wand": 1600, "robots": 1100, "status": 420}
TABS = {"cameras": "Cameras", "wand": "Calibrate", "robots": "Robots", "status": "Status"}
JPEG_QUALITY = 85
HEIGHT = 1000
NO_NOTICE = ".mantine-Notifications-root { display: none }"  # that the browser renders in software
SETTLE_MS = 1500  # for the page to draw at its new width


def main(pictures: Path | None = None, recording: Path | None = None) -> None:
    """Print the duration of each step, and what the program receives.

    Args:
        recording: a folder of an earlier run for the rendered pictures; rendered there if it does not exist.
        pictures: a folder for pictures of the page at 1600, 1100 and 420 pixels, `page_STEP.jpg`.
    """
    if reason := "chromium is not installed" if CHROMIUM is None else why_not():
        sys.exit(f"this machine can't run the benchmark: {reason}")
    with tempfile.TemporaryDirectory(prefix="roundel-first-arena-") as temporary:
        folder = Path(temporary)
        recording = (recording or folder / "recording").resolve()  # its programs run in another folder
        if not recording.exists():
            render(recording)
        start = time.monotonic()

        def show(page: Page, step: str) -> None:
            print(f"{time.monotonic() - start:.0f} s: {step}", flush=True)
            if pictures is not None and step in WIDTHS:
                take_picture(page, step, pictures)

        with Namespaces([CAMERAS]) as network, FirstArena(network, recording, folder) as arena:
            outcome = play(arena, folder, show)
    circle = outcome.circle
    print(
        f"{outcome.calibration}\n{outcome.clicks} clicks, 2 commands\n"
        f"{outcome.n_poses} poses: radius {1e3 * circle.radius_m:.2f} of "
        f"{1e3 * RADIUS_M:.0f} mm, {1e3 * circle.rms_m:.2f} mm RMS from the circle, {circle.round_s:.3f} s a round"
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
