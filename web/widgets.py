# SPDX-License-Identifier: BSD-3-Clause
"""Controls that all tabs use: a line for outcomes, buttons that run one action at a time, buttons that ask again, and
the decision on a result."""

import contextlib
import logging
import threading
import time
from collections.abc import Callable, Iterator
from contextvars import ContextVar, copy_context
from typing import Any, Generic, TypeVar

import viser

from camera_node.foundation.errors import RoundelError, printable
from web.errors import WebError
from web.html_tables import small
from web.state.feed import ArenaState

log = logging.getLogger("web")
GREY, PRIMARY = (58, 63, 74), None  # colours of buttons; None is the theme's primary colour
MAX_LABEL = 48  # characters of a change on a button
Result = TypeVar("Result")
# What is stored of a control and what is sent to browsers must have one order: two threads that set a property at once
# would leave a browser with the value that the page no longer has, and that it therefore never sends again.
_setting = threading.RLock()
acting_browser: ContextVar[viser.ClientHandle | None] = ContextVar("acting_browser", default=None)
CLOSE_S = 5.0  # for an action to save what it has when the page closes
REACTION_S = 1.0  # in which an operator cannot have seen that another one clicked first


@contextlib.contextmanager
def acting_for(client: viser.ClientHandle | None) -> Iterator[None]:
    """Within the block a browser acts, or none for None."""
    token = acting_browser.set(client)
    try:
        yield
    finally:
        acting_browser.reset(token)


@contextlib.contextmanager
def inside(container: Any) -> Iterator[None]:
    """Within the block controls are added to a folder or tab, which Viser permits to one thread at a time."""
    with _setting, container:
        yield


class Answer:
    """A line of text for the outcome of an action."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._handle = gui.add_html("", visible=False)

    def show(self, text: str, level: str = "wait") -> None:
        """Show a text in the colour of a level; an empty one hides the line."""
        with _setting:
            set_content(self._handle, small(text, level) if text else "")
            set_property(self._handle, "visible", bool(text))

    def show_outcome(self, name: str, act: Callable[[], str]) -> None:
        """Run an action and show what it returns, or its error: the page must show any failure to its user."""
        try:
            self.show(act(), "ok")
        except RoundelError as error:
            self.show(str(error), "bad")
        except Exception as error:
            log.exception("the action %s failed", name)
            self.show(f"this failed: {type(error).__name__}: {error}", "bad")


class StateText:
    """HTML that follows the state of the arena."""

    def __init__(self, gui: viser.GuiApi, write: Callable[[ArenaState], str]) -> None:
        self._handle, self._write = gui.add_html(""), write

    def update(self, state: ArenaState) -> None:
        """Show the state."""
        set_content(self._handle, self._write(state))


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
        """Run the action for a browser, unless it runs already.

        Also while the button is disabled, which its browser may not show yet: each action says why it can't act.
        """
        if not self._running.acquire(blocking=False):
            return
        self.client = client
        self._show_disabled()
        try:
            with acting_for(client):
                self._answer.show_outcome(self.handle.label, self._act)
        finally:
            self._running.release()
            self._show_disabled()

    def show(self, enabled: bool = True, primary: bool = False, label: str = "") -> None:
        """Enable the button where it can act, and colour it where it is the operator's next step."""
        self._enabled = enabled
        self._show_disabled()
        set_property(self.handle, "color", PRIMARY if primary else GREY)
        if label:
            set_property(self.handle, "label", label)

    def _show_disabled(self) -> None:
        with _setting:
            set_property(self.handle, "disabled", not self._enabled or self._running.locked())


class ConfirmedButton(ActionButton):
    """A button that acts with the second click of one browser on one subject, and else asks.

    Args:
        gui, label, answer, hint: as of `ActionButton`; the label begins with a verb.
        subject: returns on what the action acts.
        act: as of `ActionButton`.
        consequence: what the question adds.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        label: str,
        subject: Callable[[], str],
        act: Callable[[], str],
        answer: Answer,
        consequence: str = "",
        hint: str | None = None,
    ) -> None:
        super().__init__(gui, label, self._ask, answer, hint)
        self._label, self._subject, self._confirmed, self._consequence = label, subject, act, consequence
        self._asked: tuple[viser.ClientHandle | None, str] | None = None

    def show(self, enabled: bool = True, primary: bool = False, label: str = "") -> None:
        """As of `ActionButton`; the label says whether the next click acts."""
        if self._asked is not None and not self._is_asked(*self._asked):
            self._asked = None
        again = f"{self._label.split()[0]}: click again"
        super().show(enabled, primary, again if self._asked is not None else self._label)

    def _is_asked(self, client: viser.ClientHandle | None, subject: str) -> bool:
        with acting_for(client), contextlib.suppress(WebError):  # the subject is gone
            return self._subject() == subject
        return False

    def _ask(self) -> str:
        asked = self.client, self._subject()
        if self._asked != asked:
            self._asked = asked
            return f"click again to {self._label.split()[0].lower()} {asked[1]}{self._consequence}"
        self._asked = None
        return self._confirmed()


class UndoButton(ActionButton):
    """Reverts what was changed beside it, the latest change first; its label names that change."""

    def __init__(self, gui: viser.GuiApi, label: str, answer: Answer) -> None:
        super().__init__(gui, label, self._undo, answer)
        self._label = label
        self._changes: list[tuple[str, Callable[[], object]]] = []

    def note(self, about: str, revert: Callable[[], object]) -> str:
        """Remember a change in words, and what reverts it or raises RoundelError; returns the words."""
        self._changes.append((about, revert))
        return about

    def update(self) -> None:
        """Name the change that would be reverted."""
        last = f": {printable(self._changes[-1][0], MAX_LABEL)}" if self._changes else ""
        self.show(enabled=bool(self._changes), label=self._label + last)

    def _undo(self) -> str:
        if not self._changes:
            raise WebError("there is nothing to undo here")
        about, revert = self._changes.pop()
        revert()
        return f"undone: {about}"


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
        self._started: tuple[viser.ClientHandle | None, float] = None, 0.0
        self.handle = gui.add_button(labels[0], color=GREY)
        self.handle.on_click(lambda event: self.toggle(event.client))

    @property
    def is_running(self) -> bool:
        """Whether the action runs."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def is_closed(self) -> bool:
        """Whether the page closes: the action should save what it has, and end."""
        return self._closed

    def toggle(self, client: viser.ClientHandle | None = None) -> None:
        """Start the action for a browser, or end it; the click of another one at the same time does not end it."""
        with self._lock:
            now_s = time.monotonic()
            if self.is_running:
                starter, since_s = self._started
                if client is starter or now_s - since_s > REACTION_S:
                    self._end.set()
                return
            self._end.clear()
            self._started = client, now_s
            set_property(self.handle, "label", self._labels[1])
            with acting_for(client):
                run = copy_context().run
            self._thread = threading.Thread(target=run, args=[self._run], name=self._labels[0], daemon=True)
            self._thread.start()

    def show(self, enabled: bool, primary: bool = False) -> None:
        """Enable the button where the action can start; it is coloured while that is the next step or it runs."""
        set_property(self.handle, "color", PRIMARY if self.is_running or primary else GREY)
        if not self.is_running:
            set_property(self.handle, "disabled", not enabled)

    def close(self) -> None:
        """End the action and wait for it."""
        with self._lock:
            self._closed = True
            self._end.set()
        if self._thread is not None:
            self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            self._answer.show_outcome(self._labels[0], lambda: self._act(self._end))
        finally:
            set_property(self.handle, "label", self._labels[0])
            set_property(self.handle, "disabled", False)


class Decision(Generic[Result]):
    """A result that the operators of the page accept or discard.

    Args:
        gui: where the two buttons are added.
        noun: what it is, such as "the lens".
        use: uses the result; returns the outcome as text.
        forget: removes what the page shows of the result; returns what remains, or "".
        answer: the line for the outcome.

    Attributes:
        result: that awaits the decision; None for none.
    """

    def __init__(
        self,
        gui: viser.GuiApi,
        noun: str,
        use: Callable[[Result], str],
        forget: Callable[[], str],
        answer: Answer,
    ) -> None:
        self.result: Result | None = None
        self._noun, self._use, self._forget = noun, use, forget
        self._buttons = (
            ActionButton(gui, f"Accept {noun}", self.accept, answer),
            ActionButton(gui, f"Discard {noun}", self.discard, answer),
        )

    def accept(self) -> str:
        """Use the result; returns the outcome. Raises WebError without one, and what `use` raises."""
        if self.result is None:
            raise WebError(f"there is nothing to accept as {self._noun}: it was decided, or not made yet")
        outcome = self._use(self.result)
        self.clear()
        return outcome

    def discard(self) -> str:
        """Forget the result."""
        return f"discarded{self.clear()}"

    def clear(self) -> str:
        """There is no result to decide about; returns what remains."""
        self.result = None
        return self._forget()

    def show(self, enabled: bool = True) -> None:
        """Show the buttons while there is a result."""
        is_ready = enabled and self.result is not None
        for button in self._buttons:
            set_property(button.handle, "visible", is_ready)
            button.show(enabled=is_ready, primary=button is self._buttons[0])


def set_content(handle: Any, text: str) -> None:
    """Set a control's text if it differs."""
    set_property(handle, "content", text)


def set_property(handle: Any, name: str, value: object) -> None:
    """Set a property of a control if it differs: Viser sends every assignment to all browsers."""
    with _setting:
        if getattr(handle, name) != value:
            setattr(handle, name, value)


def escape_markdown(text: str) -> str:
    """Escape text from the network so that Markdown shows it literally."""
    return "".join(f"\\{c}" if c in "\\`*_{}[]()#+!|<>~$" else c for c in text)
