# SPDX-License-Identifier: BSD-3-Clause
"""Keys of the page. Viser lists the same commands for a search with Ctrl+K; keys do nothing while a text is typed."""

from collections.abc import Callable
from typing import Any

import viser

from web.html_tables import Column, HtmlTable, TableRow, small

HELP = "?"
COLUMNS = (Column("key"), Column("action"))


class Shortcuts:
    """The keys of a page; `?` shows them in the browser that asks."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._gui = gui
        self._rows: list[TableRow] = []
        # Viser's list of keys has letters only; it passes any other one to the browser, where ? comes with Shift.
        self.add(HELP, "Show the keys", self._show, modifier="shift")
        gui.add_html(small(f"{HELP} shows the keys, Ctrl+K searches for an action"))

    def add(
        self,
        key: Any,
        label: str,
        act: Callable[[viser.ClientHandle | None], object],
        modifier: Any = None,
    ) -> None:
        """Have a key call `act` with the browser in which it was pressed."""
        self._rows.append(TableRow((key, label), "ok"))
        command = self._gui.add_command(label, hotkey=key, modifier=modifier)

        @command.on_trigger
        def _(event: viser.CommandEvent) -> None:
            act(event.client)

    def _show(self, client: viser.ClientHandle | None) -> None:
        if client is None:
            return
        modal = client.gui.add_modal("Keys")
        with modal:
            client.gui.add_html(HtmlTable(COLUMNS, self._rows).html())
            client.gui.add_button("Close").on_click(lambda _: modal.close())
