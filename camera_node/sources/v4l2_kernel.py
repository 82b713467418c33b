# SPDX-License-Identifier: BSD-3-Clause
"""The kernel's interface to V4L2 devices: structures and requests of <linux/videodev2.h>, a device that takes them, and
its controls by name, such as focus_absolute; the names are those of v4l2-ctl.

Source: Linux kernel documentation, Video for Linux API, https://docs.kernel.org/userspace-api/media/v4l/v4l2.html.
"""

import ctypes
import errno
import fcntl
import os
import re
from collections.abc import Iterator, Mapping
from ctypes import c_char, c_int32, c_int64, c_uint8, c_uint32, c_uint64, c_void_p
from pathlib import Path

from camera_node.foundation.errors import CameraAbsentError, CameraError
from camera_node.protocol.messages import ControlValue
from camera_node.sources.camera_description import Control

MAX_ITEMS = 1024  # of one list of a driver, against drivers that never end it
READ, READ_WRITE = 2, 3  # directions of a request, as _IOR and _IOWR
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


class Capability(ctypes.Structure):
    """struct v4l2_capability"""

    _fields_ = [
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    ]


class FormatDescription(ctypes.Structure):
    """struct v4l2_fmtdesc"""

    _fields_ = [
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    ]


class FrameSize(ctypes.Structure):
    """struct v4l2_frmsizeenum; `size` is width and height, or least, greatest and step of both."""

    _fields_ = [
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("size", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    ]


class FrameInterval(ctypes.Structure):
    """struct v4l2_frmivalenum; `interval` is numerator and denominator, seconds, of one or of least, greatest, step."""

    _fields_ = [
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("interval", c_uint32 * 6),
        ("reserved", c_uint32 * 2),
    ]


class ControlQuery(ctypes.Structure):
    """struct v4l2_query_ext_ctrl"""

    _fields_ = [
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int64),
        ("maximum", c_int64),
        ("step", c_uint64),
        ("default_value", c_int64),
        ("flags", c_uint32),
        ("elem_size", c_uint32),
        ("elems", c_uint32),
        ("nr_of_dims", c_uint32),
        ("dims", c_uint32 * 4),
        ("reserved", c_uint32 * 32),
    ]


class MenuQuery(ctypes.Structure):
    """struct v4l2_querymenu; `text` is a name, or the 8 bytes of a number in an integer menu."""

    _pack_ = 1
    _fields_ = [("id", c_uint32), ("index", c_uint32), ("text", c_uint8 * 32), ("reserved", c_uint32)]


class _ControlContent(ctypes.Union):
    _pack_ = 1
    _fields_ = [("value", c_int32), ("value64", c_int64), ("pointer", c_void_p)]


class ControlContent(ctypes.Structure):
    """struct v4l2_ext_control"""

    _pack_ = 1
    _fields_ = [("id", c_uint32), ("size", c_uint32), ("reserved2", c_uint32), ("content", _ControlContent)]


class ControlContents(ctypes.Structure):
    """struct v4l2_ext_controls"""

    _fields_ = [
        ("which", c_uint32),
        ("count", c_uint32),
        ("error_idx", c_uint32),
        ("request_fd", c_int32),
        ("reserved", c_uint32),
        ("controls", ctypes.POINTER(ControlContent)),
    ]


def request(direction: int, number: int, kind: type[ctypes.Structure]) -> int:
    """The number of a request with an argument of this type, as <asm-generic/ioctl.h> composes it."""
    return direction << 30 | ctypes.sizeof(kind) << 16 | ord("V") << 8 | number


QUERYCAP = request(READ, 0, Capability)
ENUM_FMT = request(READ_WRITE, 2, FormatDescription)
QUERYMENU = request(READ_WRITE, 37, MenuQuery)
G_EXT_CTRLS = request(READ_WRITE, 71, ControlContents)
S_EXT_CTRLS = request(READ_WRITE, 72, ControlContents)
ENUM_FRAMESIZES = request(READ_WRITE, 74, FrameSize)
ENUM_FRAMEINTERVALS = request(READ_WRITE, 75, FrameInterval)
QUERY_EXT_CTRL = request(READ_WRITE, 103, ControlQuery)


class KernelDevice:
    """An open V4L2 device. Several programs may have it open; only one may stream.

    Raises:
        CameraAbsentError: it does not open.
    """

    def __init__(self, device: Path) -> None:
        try:
            self._file = os.open(device, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        except OSError as error:
            raise CameraAbsentError(f"{device} does not open ({error.strerror}); is it plugged in?") from None

    def close(self) -> None:
        os.close(self._file)

    def ask(self, number: int, argument: ctypes.Structure) -> bool:
        """Make a request, whose answer is in `argument`; False where the driver has none. Raises OSError."""
        try:
            fcntl.ioctl(self._file, number, argument)
        except OSError as error:
            if error.errno in (errno.EINVAL, errno.ENOTTY, errno.ENODATA):
                return False
            raise
        return True

    def items(self, number: int, argument: ctypes.Structure) -> Iterator[ctypes.Structure]:
        """Yield `argument` with each item of a list that has an index; the same object each time."""
        for index in range(MAX_ITEMS):
            argument.index = index  # pyright: ignore[reportAttributeAccessIssue]
            if not self.ask(number, argument):
                return
            yield argument


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
