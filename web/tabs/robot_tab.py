# SPDX-License-Identifier: BSD-3-Clause
"""The tab Robots: all declared robots with their state, why a robot is not tracked, and changes of one robot."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import viser

from camera_node.foundation.config import require_name
from fusion.errors import FusionError
from fusion.model.robots import Robot, move_origin, save_robots, turn_heading
from fusion.protocol.pose_messages import Robots, RobotsRequest
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.tables import tabulate_robots
from web.widgets import ActionButton, Answer, ConfirmedButton, set_content

NO_ROBOT = "no robot yet"


class RobotTable:
    """One row for each declared robot."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._table = gui.add_html("")

    def update(self, state: ArenaState) -> None:
        """Show the state."""
        set_content(self._table, tabulate_robots(state).html())


def _numbered(path: Path) -> Iterator[Path]:
    """robots.yaml, robots-1.yaml, robots-2.yaml and so on."""
    yield path
    yield from (path.with_stem(f"{path.stem}-{k}") for k in count(1))


@dataclass(frozen=True)
class RobotChange:
    """A change that this page made, and how to undo it.

    Attributes:
        about: the change in words.
        undo: the request that reverts it.
        name, after: the robot that it left, None if it deleted the robot.
    """

    about: str
    undo: RobotsRequest
    name: str
    after: Robot | None


class RobotEditor:
    """Renames, deletes and saves robots, and changes their frames; undoes these changes, the latest first.

    Args:
        gui: where the controls are added.
        subscription: connected to the arena.
        folder: where "Save" writes robots.yaml.
    """

    def __init__(self, gui: viser.GuiApi, subscription: Subscription, folder: Path) -> None:
        self._subscription, self._file = subscription, folder / "robots.yaml"
        self._changes: list[RobotChange] = []
        with gui.add_folder("One robot", expand_by_default=False):
            self._robot = gui.add_dropdown("Robot", [NO_ROBOT])
            self._name = gui.add_text("New name", "")
            self._pivot = gui.add_vector3(
                "Pivot, m", (0.0, 0.0, 0.0), step=0.001, hint="the new origin in the robot's present frame"
            )
            self._degrees = gui.add_number(
                "Turn, degrees", 90.0, step=1.0, hint="of the x axis, counterclockwise seen from above"
            )
            answer = Answer(gui)
            self._delete = ConfirmedButton(gui, "Delete", lambda: str(self._robot.value), self.delete, answer)
            self._others = (
                ActionButton(gui, "Rename", self.rename, answer),
                ActionButton(gui, "Move the pivot", self.move_pivot, answer, "the robot is acquired again"),
                ActionButton(gui, "Turn the heading", self.turn, answer, "the robot is acquired again"),
                ActionButton(gui, "Save all robots", self.save, answer, f"writes {self._file}"),
            )
            self._undo = ActionButton(gui, "Undo the change of a robot", self.undo, answer)

    def update(self, state: ArenaState) -> None:
        """Offer the declared robots."""
        names = state.declared_robots()
        if (names or (NO_ROBOT,)) != tuple(self._robot.options):
            self._robot.options = names or (NO_ROBOT,)
        for button in (self._delete, *self._others):
            button.show(enabled=bool(names))
        self._undo.show(enabled=bool(self._changes))

    def rename(self) -> str:
        """Rename the robot; it stays tracked."""
        old, new = str(self._robot.value), require_name(self._name.value, "a robot")
        robots = self._subscription.change_robots(RobotsRequest(rename={old: new}))
        self._name.value = ""
        return self._note(robots, f"{old} is {new} now", RobotsRequest(rename={new: old}), new)

    def delete(self) -> str:
        """Remove the robot."""
        name = str(self._robot.value)
        before = self._present(name)
        robots = self._subscription.change_robots(RobotsRequest(remove=(name,)))
        return self._note(robots, f"{name} is deleted", RobotsRequest(define={name: before}), name)

    def move_pivot(self) -> str:
        """Move the robot's origin."""
        name, (x, y, z) = str(self._robot.value), self._pivot.value
        about = f"the origin of {name} moved by {x:g}, {y:g}, {z:g} m"
        outcome = self._reframe(name, lambda robot: move_origin(robot, (x, y, z)), about)
        self._pivot.value = (0.0, 0.0, 0.0)
        return outcome

    def turn(self) -> str:
        """Turn the robot's x axis."""
        name, degrees = str(self._robot.value), float(self._degrees.value)
        about = f"the x axis of {name} turned by {degrees:g} degrees"
        return self._reframe(name, lambda robot: turn_heading(robot, degrees), about)

    def undo(self) -> str:
        """Revert the latest change of this page that is not undone yet, unless its robot was changed since."""
        change = self._changes.pop()
        if self._subscription.declared_robots().robots.get(change.name) != change.after:
            raise FusionError(
                f"{change.name} was changed since by another program or page; it is left as it is"
            )
        return self._describe(self._subscription.change_robots(change.undo), f"undone: {change.about}")

    def save(self) -> str:
        """Write all robots to robots.yaml; an existing file gets the next free number."""
        robots = self._subscription.declared_robots().robots
        if not robots:
            raise FusionError("there is no robot to save")
        path = next(path for path in _numbered(self._file) if not path.exists())
        save_robots(robots, path)
        return f"wrote {len(robots)} robots to {path}"

    def _present(self, name: str) -> Robot:
        robots = self._subscription.declared_robots().robots
        if name not in robots:
            raise FusionError(f"there is no robot '{name}' any more; choose another one")
        return robots[name]

    def _reframe(self, name: str, change: Callable[[Robot], Robot], about: str) -> str:
        before = self._present(name)
        robots = self._subscription.reframe_robot(name, change)
        return self._note(robots, about, RobotsRequest(define={name: before}, replace=True), name)

    def _note(self, robots: Robots, about: str, undo: RobotsRequest, name: str) -> str:
        self._changes.append(RobotChange(about, undo, name, robots.robots.get(name)))
        return self._describe(robots, about)

    def _describe(self, robots: Robots, change: str) -> str:
        unsaved = "; not saved on the server: use Save all robots" if robots.unsaved else ""
        return f"{change}{unsaved}"
