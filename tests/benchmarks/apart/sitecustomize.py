# SPDX-License-Identifier: BSD-3-Clause
"""What Python runs first where this folder is in PYTHONPATH: hides the boot id, as if programs had machines apart."""

from pathlib import Path

_read_text = Path.read_text


def read_text(path: Path, *arguments, **named) -> str:
    if path.name == "boot_id":
        raise FileNotFoundError(path)
    return _read_text(path, *arguments, **named)


Path.read_text = read_text
