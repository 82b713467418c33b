# SPDX-License-Identifier: BSD-3-Clause
"""Errors that a user can fix, and how programs report them on one line.

    RoundelError
    ├── ConfigError          a file or an option is missing or invalid
    ├── CameraError          a camera, an image or another source of frames delivers no frames
    │   └── CameraAbsentError    a camera is not plugged in, or another program uses it
    ├── NetworkError         a Zenoh endpoint is invalid, unreachable or refused
    │   └── AddressError         an address to listen on is taken, or its network is not up
    ├── calib.CalibrationError
    ├── fusion.FusionError
    └── web.WebError

Every message names the fault, its place and the remedy. Faults in live data are counted and never raised.

The exit code tells a service manager whether to retry: 2 stays until a user acts, 75 (EX_TEMPFAIL) may pass by itself.
"""

import errno
from collections.abc import Iterable
from pathlib import Path
from typing import ClassVar

USER_ERROR, TEMPORARY_FAILURE = 2, 75  # exit codes; the second is EX_TEMPFAIL of sysexits.h
MAX_LINE = 500  # characters of one message


class RoundelError(Exception):
    """Base class of all errors that a user can fix."""

    exit_code: ClassVar[int] = USER_ERROR


class ConfigError(RoundelError):
    """A file or an option is missing or invalid."""


class CameraError(RoundelError):
    """A camera, an image or another source of frames delivers no frames."""


class CameraAbsentError(CameraError):
    """A camera is not plugged in, or another program uses it."""

    exit_code = TEMPORARY_FAILURE


class NetworkError(RoundelError):
    """A Zenoh endpoint is invalid, unreachable or refused."""


class AddressError(NetworkError):
    """An address to listen on is taken, or its network is not up."""

    exit_code = TEMPORARY_FAILURE


def printable(text: object, limit: int = MAX_LINE) -> str:
    """A text from a file or a network for one line of a terminal or a log.

    What is not printable is escaped, and what exceeds `limit` characters is left out.
    """
    shown = str(text)[: limit + 1]
    escaped = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in shown)
    return escaped if len(escaped) <= limit else escaped[:limit] + "..."


def most_similar(word: str, known: Iterable[str]) -> str:
    """That of the known words which was probably meant; empty if none is similar."""
    from difflib import get_close_matches  # only mistakes need it, and every program imports this module

    return next(iter(get_close_matches(word, known, 1)), "")


def describe_failed_write(error: OSError) -> str:
    """Why a file could not be written, with what to do."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{error.strerror}; the disk is full: free some space, and repeat. Nothing was changed"
    if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{error.strerror}; make its folder writable for this user"
    if error.errno in (errno.ENOENT, errno.ENOTDIR):
        return f"{error.strerror}; does its folder exist?"
    return f"{error.strerror or error}; check its folder and its disk"


def unwritable(path: Path, error: OSError) -> ConfigError:
    """The error of a file or folder that could not be written."""
    return ConfigError(f"{path} can't be written: {describe_failed_write(error)}")
