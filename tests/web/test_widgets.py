# SPDX-License-Identifier: BSD-3-Clause
"""Buttons of the page: what browsers show is what the page has, in each order of its threads."""

import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
import viser

from tests.waiting import DEADLINE_S
from tests.web.browser import loopback
from web.errors import WebError
from web.state.feed import ArenaState, Feed
from web.view import View
from web.widgets import ActionButton, Answer, ConfirmedButton, Decision, set_property


@pytest.fixture
def gui() -> Iterator[viser.GuiApi]:
    view = View(Feed("test"), loopback())
    yield view.server.gui
    view.close()


class Slow:
    """A control whose first assignment is sent later than it is stored, as by a thread that has to wait."""

    def __init__(self) -> None:
        self.stored, self.sent = False, [False]
        self.is_stored, self.may_send = threading.Event(), threading.Event()

    @property
    def disabled(self) -> bool:
        return self.stored

    @disabled.setter
    def disabled(self, value: bool) -> None:
        self.stored = value
        if not self.is_stored.is_set():
            self.is_stored.set()
            self.may_send.wait(0.2)  # until the other thread has sent, which it can't
        self.sent.append(value)


def test_a_browser_has_what_the_page_has():
    """One thread disables a button while another one enables it: what is sent last is what is stored."""
    handle = Slow()
    disabling = threading.Thread(target=set_property, args=(handle, "disabled", True))
    disabling.start()
    assert handle.is_stored.wait(DEADLINE_S)
    set_property(handle, "disabled", False)
    handle.may_send.set()
    disabling.join(DEADLINE_S)
    assert handle.sent[-1] == handle.stored


def test_a_section_that_fails_keeps_no_other_one_from_being_shown():
    """As a button that stays disabled because a table before it fails."""
    view, updates = View(Feed("test"), loopback()), []

    def fail(state: ArenaState) -> None:
        raise ValueError("odd")

    for update in (fail, updates.append):
        section: Any = SimpleNamespace(update=update)
        view.add(section)
    view.update()
    assert len(updates) == 1
    assert view.feed.state().faults["SimpleNamespace: ValueError('odd')"] == 1
    view.close()


def test_each_browser_confirms_for_itself(gui: viser.GuiApi):
    """One operator's second click does not confirm what the other one asked; a change of the subject asks again."""
    subjects, done = ["rover"], []

    def act() -> str:
        done.append(subjects[0])
        return "deleted"

    button = ConfirmedButton(gui, "Delete", lambda: subjects[0], act, Answer(gui))
    one: Any = object()
    other: Any = object()
    button.run(one)
    button.run(other)
    button.show()
    assert (done, button.handle.label) == ([], "Delete: click again")
    button.run(other)
    assert done == ["rover"]
    button.run(one)
    subjects[0] = "drone"
    button.show()
    button.run(one)
    assert (done, button.handle.label) == (["rover"], "Delete")
    button.run(one)
    assert done == ["rover", "drone"]


def test_a_decision_is_made_once(gui: viser.GuiApi):
    """The click of another browser, which comes later, is answered in one line."""
    used: list[str] = []

    def use(result: str) -> str:
        used.append(result)
        return f"{result} is used"

    decision = Decision(gui, "the lens", use, lambda: "", Answer(gui))
    decision.result = "north"
    assert decision.accept() == "north is used"
    with pytest.raises(WebError, match="nothing to accept as the lens: it was decided, or not made yet"):
        decision.accept()
    assert used == ["north"]


def test_a_click_is_answered_though_the_button_was_just_disabled(gui: viser.GuiApi):
    """The browser showed it enabled: what makes it act may come and go with each message."""
    done: list[str] = []

    def act() -> str:
        done.append("done")
        return "done"

    button = ActionButton(gui, "Define", act, Answer(gui))
    button.show(enabled=False)
    button.run()
    assert (done, button.handle.disabled) == (["done"], True)
