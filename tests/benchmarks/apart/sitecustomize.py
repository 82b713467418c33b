# SPDX-License-Identifier: BSD-3-Clause
"""What Python runs first where this folder is in PYTHONPATH: hides the boot id, as if programs had machines apart."""

from pathlib import Path

_read_text = Path.read_text


def read_text(self: Path, encoding: str | None = None, errors: str | None = None) -> str:
    if self.name == "boot_id":
        raise FileNotFoundError(self)
    return _read_text(self, encoding, errors)


Path.read_text = read_text
