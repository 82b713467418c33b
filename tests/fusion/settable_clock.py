# SPDX-License-Identifier: BSD-3-Clause
"""A system clock that a test can set, for the programs that it starts; their monotonic clock stays the machine's."""

import os
import struct
import subprocess
from pathlib import Path

SOURCE = Path(__file__).with_suffix(".c")


class SettableClock:
    """Programs started with `environment` read Unix time through a preloaded library that adds a step.

    Args:
        folder: for the library and the file of the step.
    """

    def __init__(self, folder: Path) -> None:
        self._file, library = folder / "clock_step", folder / "settable_clock.so"
        self.set_ahead(0.0)
        command = ["cc", "-O1", "-shared", "-fPIC", SOURCE, "-o", library, "-ldl"]
        subprocess.run(command, check=True, timeout=60)
        self.environment = {**os.environ, "LD_PRELOAD": str(library), "CLOCK_STEP_FILE": str(self._file)}

    def set_ahead(self, seconds: float) -> None:
        """Set the system clock of the programs to so many seconds ahead of the machine's, in place."""
        data = struct.pack("=q", round(seconds * 1e9))
        with self._file.open("r+b" if self._file.exists() else "wb") as file:
            file.write(data)
