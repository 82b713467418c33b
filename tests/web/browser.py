# SPDX-License-Identifier: BSD-3-Clause
"""Draws a view in a thread, and opens its page in Chromium."""

import ctypes
import shutil
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import pytest
from playwright.sync_api import ConsoleMessage, Page, sync_playwright

from tests.conftest import free_port
from tests.waiting import DEADLINE_S
from web.page_access import PageAccess
from web.state.feed import Feed
from web.view import PanelSection, View

Panel = TypeVar("Panel", bound=PanelSection)
CHROMIUM = shutil.which("chromium")
FLAGS = [
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-sync",
    "--disable-component-update",
    "--no-first-run",
]
PR_CAPBSET_DROP, CAP_SYS_NICE = 24, 23  # <linux/prctl.h>, <linux/capability.h>


def loopback() -> PageAccess:
    """A page on a reserved port of this machine, without tokens."""
    return PageAccess.create("127.0.0.1", free_port())


@contextmanager
def drawing(view: View) -> Iterator[None]:
    """Draw until the block ends, then close the view."""
    stop = threading.Event()
    thread = threading.Thread(target=view.run, args=(stop,))
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        view.close()


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


def _give_up_priority() -> None:
    """Let no program that this thread starts raise its priority, as Chromium does where it runs as root.

    It draws without a graphics card, and all other programs would wait for it.
    """
    if sys.platform == "linux":  # refused to users, who can't raise it
        ctypes.CDLL(None).prctl(PR_CAPBSET_DROP, CAP_SYS_NICE, 0, 0, 0)


@contextmanager
def browsing(view: View, url: str = "") -> Iterator[Page]:
    """Open the page of a view, or another address; an error on its console fails the test. Skips without Chromium."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed; apt-get install chromium")
    errors: list[str] = []

    def record(message: ConsoleMessage) -> None:
        if message.type == "error":
            errors.append(message.text)

    _give_up_priority()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": 1000, "height": 700})
        page.set_default_timeout(1e3 * DEADLINE_S)
        page.on("console", record)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(url or view.access.address)
        try:
            yield page
        except BaseException:
            print(f"the page shows:\n{page.inner_text('body')}")  # pytest adds it to the failure
            raise
        finally:
            browser.close()
    assert not errors
