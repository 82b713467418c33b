# SPDX-License-Identifier: BSD-3-Clause
"""Controls of which each browser has its own: what one operator types or chooses changes nothing at another one.

Viser shares the controls of `ViserServer.gui` between all browsers, character by character. Those of `ClientHandle.gui`
belong to one browser, and may be in a folder that all share.
"""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import viser

from web.errors import WebError
from web.widgets import acting_browser, acting_for, inside, set_property

Handle = TypeVar("Handle", bound=Any)
CHOOSE = "choose one"  # in the place of what another operator renamed or removed


class OwnControl(Generic[Handle]):
    """One control for each browser, at one place of the panel.

    Args:
        server: of the page.
        container: the folder or tab in whose `with` block this object is created.
        add: adds the control.
    """

    def __init__(
        self, server: viser.ViserServer, container: Any, add: Callable[[viser.GuiApi], Handle]
    ) -> None:
        self._container, self._add = container, add
        self._common = add(server.gui)  # never shown: the place, and what a new browser begins with
        self._common.visible = False
        self._own: dict[int, Handle] = {}
        server.on_client_connect(self._connect)
        server.on_client_disconnect(lambda client: self._own.pop(client.client_id, None))

    @property
    def here(self) -> Any:
        """The control of the browser whose action runs; without one, what a new browser begins with."""
        client = acting_browser.get()
        return self._common if client is None else self._own.get(client.client_id, self._common)

    @property
    def chosen(self) -> str:
        """What the browser chose in a list. Raises WebError if another operator renamed or removed it."""
        if self.here.value == CHOOSE:
            raise WebError("what was chosen here was renamed or removed meanwhile: choose one")
        return str(self.here.value)

    def offer(self, names: Sequence[str], none: str) -> None:
        """Offer names in a list, in all browsers; no browser gets another choice than the one that it made."""
        for handle in (self._common, *list(self._own.values())):
            is_open = handle.value not in names and tuple(handle.options) != (none,)
            options = ((CHOOSE,) if is_open and names else ()) + (tuple(names) or (none,))
            set_property(handle, "options", options)

    async def _connect(self, client: viser.ClientHandle) -> None:
        with inside(self._container):
            handle = self._add(client.gui)
        handle.order = self._common.order
        for name in ("options", "value"):
            if hasattr(handle, name):
                set_property(handle, name, getattr(self._common, name))
        self._own[client.client_id] = handle


def each_browser(server: viser.ViserServer) -> Iterator[viser.ClientHandle]:
    """All browsers; in the body of the loop `OwnControl.here` is that of the browser."""
    for client in server.get_clients().values():
        with acting_for(client):
            yield client
