# SPDX-License-Identifier: BSD-3-Clause
"""Several robots at once, which all browsers select together."""

import viser

from web.html_tables import small
from web.state.feed import ArenaState
from web.tables import NO_ROBOT
from web.widgets import GREY, set_content, set_property


class RobotSelection:
    """The folder "Several robots": a click on a name selects a robot, or no longer.

    Attributes:
        names: the selected robots, sorted.
        folder: for further controls.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        self.names: tuple[str, ...] = ()
        self.folder = gui.add_folder("Several robots", expand_by_default=False)
        with self.folder:
            self._buttons = gui.add_button_group("Select", [NO_ROBOT])
            self._line = gui.add_html("")
            everything = gui.add_button("Select all or none", color=GREY)
            self._alone = gui.add_checkbox("Show only the selected robots", False)
        self._declared: tuple[str, ...] = ()

        @self._buttons.on_click
        async def _(event: viser.GuiEvent) -> None:  # on the event loop: the value is that of this click
            self._toggle(str(self._buttons.value))

        everything.on_click(lambda _: self._select(() if self.names else self._declared))

    def update(self, state: ArenaState) -> None:
        """Offer the declared robots; one that is gone is no longer selected."""
        self._declared = state.declared_robots()
        set_property(self._buttons, "options", self._declared or (NO_ROBOT,))
        self._select(self.names)

    def is_shown(self, robot: str) -> bool:
        """Whether the scene shows a robot."""
        return not self._alone.value or robot in self.names

    def _toggle(self, name: str) -> None:
        self._select(set(self.names) ^ {name})

    def _select(self, names: set[str] | tuple[str, ...]) -> None:
        self.names = tuple(sorted(set(names) & set(self._declared)))
        set_content(self._line, small(f"selected: {', '.join(self.names) or 'none'}"))
