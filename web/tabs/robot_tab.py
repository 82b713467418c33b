# SPDX-License-Identifier: BSD-3-Clause
"""The tab Robots: changes of declared robots, and how they are undone."""

from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path

import viser

from camera_node.foundation.config import require_name
from fusion.errors import FusionError
from fusion.model.robots import Robot, move_origin, save_robots, turn_heading
from fusion.protocol.pose_messages import Robots, RobotsRequest
from web.own_control import OwnControl
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.tables import NO_ROBOT
from web.tabs.robot_selection import RobotSelection
from web.widgets import ActionButton, Answer, ConfirmedButton, UndoButton


def _numbered(path: Path) -> Iterator[Path]:
    """robots.yaml, robots-1.yaml, robots-2.yaml and so on."""
    yield path
    yield from (path.with_stem(f"{path.stem}-{k}") for k in count(1))


class RobotEditor:
    """Renames, deletes and saves robots, and changes their frames; undoes these changes, the latest first.

    Args:
        server: of the page.
        subscription: connected to the arena.
        folder: where "Save" writes robots.yaml.
        selection: the robots that are deleted together.
    """

    def __init__(
        self, server: viser.ViserServer, subscription: Subscription, folder: Path, selection: RobotSelection
    ) -> None:
        self._subscription, self._file, self._selection = subscription, folder / "robots.yaml", selection
        gui, answer = server.gui, Answer(server.gui)
        place = gui.add_folder("One robot", expand_by_default=False)
        with place:
            self._robot = OwnControl(server, place, lambda gui: gui.add_dropdown("Robot", [NO_ROBOT]))
            self._name = OwnControl(server, place, lambda gui: gui.add_text("New name", ""))
            self._pivot = OwnControl(server, place, _add_pivot)
            self._degrees = OwnControl(server, place, _add_degrees)
            self._one = (
                ConfirmedButton(gui, "Delete", lambda: self._robot.chosen, self.delete, answer),
                ActionButton(gui, "Rename", self.rename, answer),
                ActionButton(gui, "Move the pivot", self.move_pivot, answer, "the robot is acquired again"),
                ActionButton(gui, "Turn the heading", self.turn, answer, "the robot is acquired again"),
            )
        with selection.folder:
            self._delete = ConfirmedButton(
                gui, "Delete the selected robots", lambda: ", ".join(selection.names), self.delete_all, answer
            )
        self._save = ActionButton(gui, "Save all robots", self.save, answer, f"writes {self._file}")
        self.undo_button = UndoButton(gui, "Undo the change of a robot", answer)

    def update(self, state: ArenaState) -> None:
        """Offer the declared robots, and say which change would be undone."""
        names = sorted(state.declared)  # a status of before the latest change has other ones
        self._robot.offer(names, NO_ROBOT)
        for button in (*self._one, self._save):
            button.show(enabled=bool(names))
        self._delete.show(enabled=bool(self._selection.names))
        self.undo_button.update()

    def rename(self) -> str:
        """Rename the robot; it stays tracked."""
        old, new = self._robot.chosen, require_name(self._name.here.value, "a robot")
        robots = self._subscription.change_robots(RobotsRequest(rename={old: new}))
        self._robot.offer(sorted(robots.robots), NO_ROBOT)
        self._robot.here.value, self._name.here.value = new, ""
        return self._note(robots, f"{old} is {new} now", RobotsRequest(rename={new: old}), new)

    def delete(self) -> str:
        """Remove the robot."""
        return self._remove((self._robot.chosen,))

    def delete_all(self) -> str:
        """Remove the selected robots."""
        if not self._selection.names:
            raise FusionError("no robot is selected; click names above")
        return self._remove(self._selection.names)

    def move_pivot(self) -> str:
        """Move the robot's origin."""
        name, (x, y, z) = self._robot.chosen, self._pivot.here.value
        about = f"the origin of {name} moved by {x:g}, {y:g}, {z:g} m"
        outcome = self._reframe(name, lambda robot: move_origin(robot, (x, y, z)), about)
        self._pivot.here.value = (0.0, 0.0, 0.0)
        return outcome

    def turn(self) -> str:
        """Turn the robot's x axis."""
        name, degrees = self._robot.chosen, float(self._degrees.here.value)
        about = f"the x axis of {name} turned by {degrees:g} degrees"
        return self._reframe(name, lambda robot: turn_heading(robot, degrees), about)

    def _revert(self, undo: RobotsRequest, after: dict[str, Robot | None]) -> None:
        """Send a request, unless the robots are no longer those `after` the change."""
        present = self._subscription.declared_robots().robots
        if changed := [name for name, robot in after.items() if present.get(name) != robot]:
            raise FusionError(
                f"{', '.join(changed)} changed since, by another program or page: nothing is undone"
            )
        self._subscription.change_robots(undo)

    def save(self) -> str:
        """Write all robots to robots.yaml; an existing file gets the next free number."""
        robots = self._subscription.declared_robots().robots
        if not robots:
            raise FusionError("there is no robot to save")
        path = next(path for path in _numbered(self._file) if not path.exists())
        save_robots(robots, path)
        return f"wrote {len(robots)} robots to {path}"

    def _remove(self, names: tuple[str, ...]) -> str:
        before = self._present(names)
        robots = self._subscription.change_robots(RobotsRequest(remove=names))
        verb = "is" if len(names) == 1 else "are"
        return self._note(robots, f"{', '.join(names)} {verb} deleted", RobotsRequest(define=before), *names)

    def _present(self, names: tuple[str, ...]) -> dict[str, Robot]:
        robots = self._subscription.declared_robots().robots
        if gone := [name for name in names if name not in robots]:
            raise FusionError(f"there is no robot '{gone[0]}' any more; choose another one")
        return {name: robots[name] for name in names}

    def _reframe(self, name: str, change: Callable[[Robot], Robot], about: str) -> str:
        before = self._present((name,))
        robots = self._subscription.reframe_robot(name, change)
        return self._note(robots, about, RobotsRequest(define=before, replace=True), name)

    def _note(self, robots: Robots, about: str, undo: RobotsRequest, *names: str) -> str:
        self.undo_button.note(
            about, partial(self._revert, undo, {name: robots.robots.get(name) for name in names})
        )
        return f"{about}{'; not saved on the server: use Save all robots' if robots.unsaved else ''}"


def _add_pivot(gui: viser.GuiApi) -> viser.GuiVector3Handle:
    hint = "the new origin in the robot's present frame"
    return gui.add_vector3("Pivot, m", (0.0, 0.0, 0.0), step=0.001, hint=hint)


def _add_degrees(gui: viser.GuiApi) -> viser.GuiNumberHandle[float]:
    hint = "of the x axis, counterclockwise seen from above"
    return gui.add_number("Turn, degrees", 90.0, step=1.0, hint=hint)
