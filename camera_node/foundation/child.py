# SPDX-License-Identifier: BSD-3-Clause
"""Runs a program as a child that ends with its parent: `python -m camera_node.foundation.child MODULE ARGUMENTS`.

The parent holds the other end of standard input. The operating system closes it when the parent ends, even by SIGKILL.
"""

import os
import runpy
import signal
import sys
import threading

GRACE_S = 5.0  # between SIGTERM and the end without clean-up


def end_with_parent() -> None:
    """Wait until standard input is closed; then end this process as SIGTERM does, or at once after `GRACE_S`."""
    while os.read(sys.stdin.fileno(), 1024):
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    threading.Event().wait(GRACE_S)
    os._exit(128 + signal.SIGTERM)


def main() -> None:
    """Run the module whose name is the first argument as `python -m` does, with the other arguments."""
    threading.Thread(target=end_with_parent, name="parent", daemon=True).start()
    module = sys.argv.pop(1)
    runpy.run_module(module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
