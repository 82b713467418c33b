# SPDX-License-Identifier: BSD-3-Clause
"""Hides the boot id from Python programs with this folder in PYTHONPATH, as if they ran on separate machines."""

from pathlib import Path

_read_text = Path.read_text


def read_text(self: Path, encoding: str | None = None, errors: str | None = None) -> str:
    if self.name == "boot_id":
        raise FileNotFoundError(self)
    return _read_text(self, encoding, errors)


Path.read_text = read_text
