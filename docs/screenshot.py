# SPDX-License-Identifier: BSD-3-Clause
"""Creates docs/demo.png: `.venv/bin/python docs/screenshot.py` runs the demo and takes a picture of its page."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import sync_playwright

PORT = 8099
FLAGS = ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
OFFLINE = [
    "--disable-background-networking",
    "--disable-sync",
    "--disable-component-update",
    "--no-first-run",
]


def main() -> None:
    """Run the demo until the robots have trails, take the picture, and end the demo."""
    command = [sys.executable, "-m", "web", "--demo", "--port", str(PORT), "--seconds", "120"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as demo:
        try:
            assert demo.stdout is not None
            os.nice(15)  # software rendering in the browser must not take time from the arena
            for line in demo.stdout:
                print(line, end="", flush=True)
                if line.startswith("8 s: error"):
                    take_screenshot(Path(__file__).with_name("demo.png"))
                    break
        finally:
            demo.terminate()
            demo.communicate()


def take_screenshot(path: Path) -> None:
    """Save the page, without the notification about software rendering."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=FLAGS + OFFLINE)
        page = browser.new_page(viewport={"width": 1280, "height": 720})
        page.goto(f"http://127.0.0.1:{PORT}")
        page.get_by_text("rover").first.wait_for()
        page.get_by_text("Software WebGL").wait_for()
        page.locator(".mantine-Notification-closeButton").first.click()
        page.wait_for_timeout(9_000)
        image = cv2.imdecode(np.frombuffer(page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        browser.close()
    cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
