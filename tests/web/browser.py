# SPDX-License-Identifier: BSD-3-Clause
"""Draws a view in a thread, and opens its page in Chromium, of which one process serves all tests, as one of Playwright
does: their starts are a third of the work of a test."""

import functools
import shutil
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import pytest
from playwright.sync_api import Browser, ConsoleMessage, Page, sync_playwright

from tests.conftest import free_port
from tests.processes import killed_at_end
from tests.waiting import DEADLINE_S, in_thread, wait_for
from web.page_access import PageAccess
from web.state.feed import Feed
from web.view import PanelSection, View

Panel = TypeVar("Panel", bound=PanelSection)
CHROMIUM = shutil.which("chromium")
FLAGS = [
    "--disable-gpu",  # what is drawn by WebGL is drawn in software; all else without its detour
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-sync",
    "--disable-component-update",
    "--no-first-run",
    "--headless",
    "--remote-debugging-port=0",
]
# Chromium ends with the tests, and may not raise its priority, as it does where it runs as root: it draws without a
# graphics card, and all other programs would wait for it. PR_SET_PDEATHSIG and PR_CAPBSET_DROP of CAP_SYS_NICE, which
# is refused to users, who can't raise it.
START = """
import ctypes, os, signal, sys
if sys.platform == "linux":
    prctl = ctypes.CDLL(None).prctl
    prctl(1, signal.SIGKILL, 0, 0, 0)
    prctl(24, 23, 0, 0, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""
# Without a graphics card the processor draws the scene, as often as it can: a core while the page shows an arena. Five
# small pictures a second are enough for a test.
DRAW_SELDOM = """
const draw = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = callback => window.setTimeout(() => draw(callback), 200);
window.cancelAnimationFrame = window.clearTimeout.bind(window);
"""
_until_the_end = ExitStack()


def loopback() -> PageAccess:
    """A page on a reserved port of this machine, without tokens."""
    return PageAccess.create("127.0.0.1", free_port())


@contextmanager
def drawing(view: View) -> Iterator[None]:
    """Draw until the block ends, then close the view."""
    stop = threading.Event()
    with closing(view), in_thread(partial(view.run, stop), stop.set):
        yield


@contextmanager
def showing(feed: Feed, make: Callable[[View], Panel]) -> Iterator[tuple[View, Panel]]:
    """A view that draws, and one panel on it, which `make` adds; the panel is closed at the end if it can be."""
    view = View(feed, loopback())
    panel = make(view)
    view.add(panel)
    with drawing(view):
        try:
            yield view, panel
        finally:
            getattr(panel, "close", lambda: None)()


def value_of(view: View, label: str) -> Any:
    """The value of the first control with a label, as the page's process has it; of a browser if it has its own."""
    guis = [*(client.gui for client in view.server.get_clients().values()), view.server.gui]
    handles = [handle for gui in guis for handle in list(gui._gui_input_handle_from_uuid.values())]
    return next(handle.value for handle in handles if getattr(handle, "label", None) == label)


def set_checkbox(page: Page, view: View, label: str, checked: bool = True) -> None:
    """Click the checkbox after a label until the page's process has its value. Its input lies below what is drawn,
    so Playwright can't wait for it to be still, and a click misses it while the page moves."""
    box = page.locator(f"xpath=//*[text()='{label}']/following::input[@type='checkbox'][1]")

    def click() -> None:
        if box.is_checked() != checked:
            box.click(force=True)

    wait_for(lambda: value_of(view, label) == checked, click)


@functools.cache
def _start_chromium(program: str) -> Callable[[], Browser]:
    """Start Chromium; each call of the result is a connection to it, which closes what was opened by it alone."""
    folder = tempfile.TemporaryDirectory(prefix="roundel-chromium-", ignore_cleanup_errors=True)
    profile = Path(_until_the_end.enter_context(folder))
    command = [sys.executable, "-c", START, program, *FLAGS, f"--user-data-dir={profile}"]
    _until_the_end.enter_context(killed_at_end(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL))
    written = profile / "DevToolsActivePort"
    wait_for(lambda: written.exists() and written.read_text().count("\n"))
    address = f"http://127.0.0.1:{written.read_text().splitlines()[0]}"
    playwright = _until_the_end.enter_context(sync_playwright())
    return lambda: playwright.chromium.connect_over_cdp(address)


def end_chromium() -> None:
    """Until the next test of the page. Playwright leaves the thread of the tests an event loop that runs."""
    _until_the_end.close()
    _start_chromium.cache_clear()


@contextmanager
def browsing(view: View, url: str = "") -> Iterator[Page]:
    """Open the page of a view, or another address; an error on its console fails the test. Skips without Chromium."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed; apt-get install chromium")
    errors: list[str] = []

    def record(message: ConsoleMessage) -> None:
        if message.type == "error":
            errors.append(message.text)

    with _start_chromium(CHROMIUM)() as browser:
        page = browser.new_page(viewport={"width": 1000, "height": 700}, device_scale_factor=0.25)
        page.set_default_timeout(1e3 * DEADLINE_S)
        page.add_init_script(DRAW_SELDOM)
        page.on("console", record)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(url or view.access.address)
        try:
            yield page
        except BaseException:
            print(f"the page shows:\n{page.inner_text('body')}")  # pytest adds it to the failure
            raise
    assert not errors
