# SPDX-License-Identifier: BSD-3-Clause
"""What a user can mend, and how a program says it.

    RoundelError
    ├── ConfigError          a file or an option: missing, broken, or of the wrong kind
    ├── CameraError          a camera, an image or another source of frames
    ├── NetworkError         a Zenoh endpoint: taken, unreachable or refused
    ├── calib.CalibrationError
    ├── fusion.FusionError
    └── web.WebError

Every message says what is wrong, where, and what to do. Faults in live data are never raised: they are counted.
"""

import difflib
import os
import sys
from collections.abc import Callable, Sequence


class RoundelError(Exception):
    """The base of every fault that a user can mend."""


class ConfigError(RoundelError):
    """A file or an option that is missing, broken or of the wrong kind."""


class CameraError(RoundelError):
    """A camera, an image or another source of frames that does not deliver."""


class NetworkError(RoundelError):
    """A Zenoh endpoint that is taken, unreachable or refused."""


def run(program: Callable[[], int | None]) -> None:
    """Run a command line program and exit: 0 or its own code; 2 with one line for a fault a user can mend."""
    try:
        code = program()
    except RoundelError as error:
        print(f"error: {error}", file=sys.stderr)
        code = 2
    except KeyboardInterrupt:
        code = 130
    except BrokenPipeError:  # whoever read the output has seen enough, as in `detect --json | head`
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        code = 0
    sys.exit(code or 0)


def check_command(arguments: Sequence[str], known: Sequence[str]) -> None:
    """Raise ConfigError where the first argument is meant as a command, and is none of those known."""
    if not arguments or arguments[0].startswith("-") or arguments[0] in known:
        return
    meant = difflib.get_close_matches(arguments[0], known, 1)
    hint = f"did you mean {meant[0]}?" if meant else f"there are {', '.join(known)}"
    raise ConfigError(f"there is no command '{arguments[0]}'; {hint} (--help tells the options)")
