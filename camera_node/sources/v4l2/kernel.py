# SPDX-License-Identifier: BSD-3-Clause
"""The kernel's interface to V4L2 devices: structures and requests of <linux/videodev2.h>, and a device that takes them.

Source: Linux kernel documentation, Video for Linux API, https://docs.kernel.org/userspace-api/media/v4l/v4l2.html.
"""

import ctypes
import errno
import fcntl
import os
from collections.abc import Iterator
from ctypes import c_char, c_int32, c_int64, c_uint8, c_uint32, c_uint64, c_void_p
from pathlib import Path

from camera_node.foundation.errors import CameraAbsentError

MAX_ITEMS = 1024  # of one list of a driver, against drivers that never end it


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


READ, READ_WRITE = 2, 3  # directions of a request, as _IOR and _IOWR


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
