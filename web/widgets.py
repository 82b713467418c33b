# SPDX-License-Identifier: BSD-3-Clause
"""Controls that all tabs use: a line for outcomes, and buttons that run one action at a time."""

import logging
import threading
from collections.abc import Callable
from typing import Any

import viser

from camera_node.foundation.errors import RoundelError
from web.html_tables import small

log = logging.getLogger("web")
GREY, PRIMARY = (58, 63, 74), None  # colours of buttons; None is the theme's primary colour


class Answer:
    """A line of text for the outcome of an action."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._handle = gui.add_html("", visible=False)

    def show(self, text: str, level: str = "wait") -> None:
        """Show a text in the colour of a level; an empty one hides the line."""
        set_content(self._handle, small(text, level) if text else "")
        if self._handle.visible != bool(text):
            self._handle.visible = bool(text)


class ActionButton:
    """A button that runs an action, shows its outcome, and is disabled while it runs.

    Args:
        gui: where the button is added.
        label: of the button.
        act: returns the outcome as text; a RoundelError is shown, any other exception is logged and shown.
        answer: the line for the outcome.
        hint: explanation that is shown when the pointer is on the button.

    Attributes:
        client: the browser of the latest click; None before.
    """

    def __init__(
        self, gui: viser.GuiApi, label: str, act: Callable[[], str], answer: Answer, hint: str | None = None
    ) -> None:
        self._act, self._answer = act, answer
        self._running = threading.Lock()
        self._enabled = True
        self.client: viser.ClientHandle | None = None
        self.handle = gui.add_button(label, color=GREY, hint=hint)
        self.handle.on_click(lambda event: self.run(event.client))

    def run(self, client: viser.ClientHandle | None = None) -> None:
        """Run the action for a browser, unless it runs already or can not act."""
        if not self._enabled or not self._running.acquire(blocking=False):
            return
        self.client, self.handle.disabled = client, True
        try:
            self._answer.show(self._act(), "ok")
        except RoundelError as error:
            self._answer.show(str(error), "bad")
        except Exception as error:  # the page must show any failure to its user
            log.exception("the action %s failed", self.handle.label)
            self._answer.show(f"this failed: {type(error).__name__}: {error}", "bad")
        finally:
            self._running.release()
            self.handle.disabled = not self._enabled

    def show(self, enabled: bool = True, primary: bool = False, label: str = "") -> None:
        """Enable the button where it can act, and colour it where it is the operator's next step."""
        self._enabled = enabled
        disabled = not enabled or self._running.locked()
        for name, value in (("disabled", disabled), ("color", PRIMARY if primary else GREY)):
            set_property(self.handle, name, value)
        if label:
            set_property(self.handle, "label", label)


class LongAction:
    """A button that starts an action in a thread of its own, and ends it at the second click.

    Args:
        gui: where the button is added.
        labels: of the button, to start and to end the action.
        act: called with an event that is set to end it; returns the outcome as text; errors as in `ActionButton`.
        answer: the line for the outcome.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        labels: tuple[str, str],
        act: Callable[[threading.Event], str],
        answer: Answer,
    ) -> None:
        self._labels, self._act, self._answer = labels, act, answer
        self._lock, self._end = threading.Lock(), threading.Event()
        self._thread: threading.Thread | None = None
        self._closed = False
        self.handle = gui.add_button(labels[0], color=GREY)
        self.handle.on_click(lambda _: self.toggle())

    @property
    def is_running(self) -> bool:
        """Whether the action runs."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def is_closed(self) -> bool:
        """Whether the page closes: the action should save what it has, and end."""
        return self._closed

    def toggle(self) -> None:
        """Start the action, or end it."""
        with self._lock:
            if self.is_running:
                self._end.set()
                return
            self._end.clear()
            self.handle.label = self._labels[1]
            self._thread = threading.Thread(target=self._run, name=self._labels[0], daemon=True)
            self._thread.start()

    def show(self, enabled: bool, primary: bool = False) -> None:
        """Enable the button where the action can start; it is coloured while that is the next step or it runs."""
        set_property(self.handle, "color", PRIMARY if self.is_running or primary else GREY)
        if not self.is_running:
            set_property(self.handle, "disabled", not enabled)

    def close(self, timeout_s: float) -> None:
        """End the action and wait for it."""
        with self._lock:
            self._closed = True
            self._end.set()
        if self._thread is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            self._answer.show(self._act(self._end))
        except RoundelError as error:
            self._answer.show(str(error), "bad")
        except Exception as error:  # the page must show any failure to its user
            log.exception("the action %s failed", self._labels[0])
            self._answer.show(f"this failed: {type(error).__name__}: {error}", "bad")
        finally:
            self.handle.label, self.handle.disabled = self._labels[0], False


def set_content(handle: Any, text: str) -> None:
    """Set a control's text if it differs."""
    set_property(handle, "content", text)


def set_property(handle: Any, name: str, value: object) -> None:
    """Set a property of a control if it differs: Viser sends every assignment to all browsers."""
    if getattr(handle, name) != value:
        setattr(handle, name, value)


def escape_markdown(text: str) -> str:
    """Escape text from the network so that Markdown shows it literally."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+!|<>~$" else c for c in text)
