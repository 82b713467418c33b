# SPDX-License-Identifier: BSD-3-Clause
"""The commands and programs in the pages of the documentation."""

import re

from tests.conftest import ROOT

SHELL = re.compile(r"^```sh\n(.*?)^```", re.DOTALL | re.MULTILINE)
PYTHON = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def commands(text: str) -> list[str]:
    """The lines of its blocks of shell commands."""
    return [line for block in SHELL.findall(text) for line in block.splitlines()]


def page(name: str) -> list[str]:
    """The commands of a page in `docs`."""
    return commands((ROOT / "docs" / name).read_text())


def programs(name: str) -> list[str]:
    """The Python programs of a page in `docs`."""
    return PYTHON.findall((ROOT / "docs" / name).read_text())
