# SPDX-License-Identifier: BSD-3-Clause
"""Controls of a V4L2 device by name, such as focus_absolute; the names are those of v4l2-ctl."""

import ctypes
import re
from collections.abc import Iterator, Mapping

from camera_node.foundation.errors import CameraError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.controls import Control
from camera_node.sources.v4l2.kernel import (
    G_EXT_CTRLS,
    MAX_ITEMS,
    QUERY_EXT_CTRL,
    QUERYMENU,
    S_EXT_CTRLS,
    ControlContent,
    ControlContents,
    ControlQuery,
    KernelDevice,
    MenuQuery,
)

NEXT = 0x80000000  # V4L2_CTRL_FLAG_NEXT_CTRL
DISABLED, READ_ONLY, WRITE_ONLY = 0x1, 0x4, 0x40
INTEGER, BOOLEAN, MENU, BUTTON, INTEGER64, BITMASK, INTEGER_MENU = 1, 2, 3, 4, 5, 8, 9
KINDS = {
    INTEGER: "integer",
    BOOLEAN: "boolean",
    MENU: "menu",
    BUTTON: "button",
    INTEGER64: "integer",
    BITMASK: "integer",
    INTEGER_MENU: "menu",
}
GAIN, EXPOSURE_AUTO, EXPOSURE_ABSOLUTE, ANALOGUE_GAIN = 0x00980913, 0x009A0901, 0x009A0902, 0x009E0903
MANUAL = 1  # V4L2_EXPOSURE_MANUAL
EXPOSURE_UNIT_US = 100.0  # of V4L2_CID_EXPOSURE_ABSOLUTE


class ControlSet:
    """The controls of an open device.

    Args:
        device: stays open.
        name: of the camera in errors.
    """

    def __init__(self, device: KernelDevice, name: str) -> None:
        self._device, self._name = device, name
        self._queries = {_name_of(query): query for query in self._query_all()}
        self._menus = {
            name: self._menu(query)
            for name, query in self._queries.items()
            if query.type in (MENU, INTEGER_MENU)
        }

    def offered(self) -> dict[str, Control]:
        """All controls by name."""
        return {name: self._describe(name, query) for name, query in self._queries.items()}

    def set(self, controls: Mapping[str, ControlValue]) -> None:
        """Set controls by name, in order. Raises CameraError where the camera refuses one."""
        for name, value in controls.items():
            entries = {text: index for index, text in self._menus.get(name, {}).items()}
            number = entries.get(value, 0) if isinstance(value, str) else int(value)
            self._write(self._queries[name], number)

    def set_exposure(self, exposure_us: float | None, gain: float | None) -> None:
        """Set the exposure, which becomes manual, and the gain. Raises CameraError where the camera refuses one."""
        if exposure_us is not None:
            if (automatic := self._find(EXPOSURE_AUTO)) is not None:
                self._write(automatic, MANUAL)
            exposure = self._require("exposure", EXPOSURE_ABSOLUTE)
            self._write(exposure, max(1, round(exposure_us / EXPOSURE_UNIT_US)))
        if gain is not None:
            self._write(self._require("gain", GAIN, ANALOGUE_GAIN), round(gain))

    def _query_all(self) -> Iterator[ControlQuery]:
        query = ControlQuery(id=NEXT)
        for _ in range(MAX_ITEMS):
            if not self._device.ask(QUERY_EXT_CTRL, query):
                return
            if query.type in KINDS and not query.flags & (DISABLED | READ_ONLY):
                yield ControlQuery.from_buffer_copy(query)
            query = ControlQuery(id=query.id | NEXT)

    def _menu(self, query: ControlQuery) -> dict[int, str]:
        """The entries of a menu by their numbers, which may have gaps."""
        entries = {}
        for index in range(query.minimum, min(query.maximum, query.minimum + MAX_ITEMS) + 1):
            item = MenuQuery(id=query.id, index=index)
            if self._device.ask(QUERYMENU, item):
                raw = bytes(item.text)
                number = int.from_bytes(raw[:8], "little", signed=True)
                text = raw.split(b"\0")[0].decode(errors="replace")
                entries[index] = str(number) if query.type == INTEGER_MENU else text
        return entries

    def _describe(self, name: str, query: ControlQuery) -> Control:
        menu = self._menus.get(name, {})
        value = self._read(query)
        is_number = query.type in (INTEGER, INTEGER64, BITMASK, MENU, INTEGER_MENU)
        return Control(
            name=name,
            kind=KINDS[query.type],  # pyright: ignore[reportArgumentType]: one of the literals
            low=query.minimum if is_number else None,
            high=query.maximum if is_number else None,
            step=query.step if query.type in (INTEGER, INTEGER64) else None,
            entries=tuple(menu.values()),
            value=menu.get(value, value) if value is not None else None,
        )

    def _read(self, query: ControlQuery) -> int | None:
        if query.type == BUTTON or query.flags & WRITE_ONLY:
            return None
        content = ControlContent(id=query.id)
        try:
            if not self._device.ask(G_EXT_CTRLS, _wrapped(content)):
                return None
        except OSError:
            return None
        return content.content.value64 if query.type == INTEGER64 else content.content.value

    def _write(self, query: ControlQuery, value: int) -> None:
        content = ControlContent(id=query.id)
        if query.type == INTEGER64:
            content.content.value64 = value
        else:
            content.content.value = value
        text = f"{self._name} refuses {_name_of(query)} = {value}"
        try:
            if not self._device.ask(S_EXT_CTRLS, _wrapped(content)):
                raise CameraError(f"{text}; give a number from {query.minimum} to {query.maximum}")
        except OSError as error:
            raise CameraError(f"{text} ({error.strerror}); an automatic control may own it") from None

    def _find(self, *ids: int) -> ControlQuery | None:
        return next((query for id in ids for query in self._queries.values() if query.id == id), None)

    def _require(self, what: str, *ids: int) -> ControlQuery:
        query = self._find(*ids)
        if query is None:
            raise CameraError(
                f"{self._name} has no {what} to set; roundel camera --list --json shows its controls"
            )
        return query


def _wrapped(content: ControlContent) -> ControlContents:
    return ControlContents(count=1, controls=ctypes.pointer(content))


def _name_of(query: ControlQuery) -> str:
    """A driver's name such as "Exposure Time, Absolute" as v4l2-ctl writes it: exposure_time_absolute."""
    return re.sub(r"[^a-z0-9]+", "_", query.name.decode(errors="replace").lower()).strip("_")
