# SPDX-License-Identifier: BSD-3-Clause
"""One program at a time saves in a folder; a program that is killed leaves no lock."""

import contextlib
import os
import shlex
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

from camera_node.foundation.errors import ConfigError, printable

MAX_HOLDER = 400  # bytes of the holder's description


@contextlib.contextmanager
def locked_folder(folder: Path, program: str) -> Iterator[None]:
    """Hold the folder's lock of a kind of program until the block ends, by flock(2) on a file in the folder.

    A folder that does not exist, or in which this user may not write, needs no lock: nothing is saved there.

    Args:
        folder: in which the program saves.
        program: such as "server"; programs of another name have a lock of their own.

    Raises:
        ConfigError: another process holds it; the message names that.
    """
    import fcntl  # not at the top: Windows has none, and its programs save in no shared folder

    try:
        lock = os.open(
            folder / f".{program.replace(' ', '-')}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644
        )
    except OSError:
        yield
        return
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = printable(os.pread(lock, MAX_HOLDER, 0).decode(errors="replace").strip(), MAX_HOLDER)
            raise ConfigError(
                f"another {program} saves in {folder}: {holder or 'it just starts'}; end that one, or use another "
                "folder, because each would overwrite what the other saves"
            ) from None
        os.ftruncate(lock, 0)
        os.pwrite(lock, f"{_describe_this_process()}\n".encode()[:MAX_HOLDER], 0)
        yield
    finally:
        os.close(lock)


def _describe_this_process() -> str:
    return f"process {os.getpid()} on {socket.gethostname()}, {shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]])}"
