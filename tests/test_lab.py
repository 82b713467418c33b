# SPDX-License-Identifier: BSD-3-Clause
"""The systemd services of configs/systemd."""

import configparser
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import tyro

from camera_node.commands.publish import Publish
from fusion.commands.serve import Serve
from tests.conftest import ROOT
from web.roundel.serve_page import ViewArena

PROGRAMS: dict[str, Callable[[list[str]], object]] = {
    "roundel-fusion": lambda words: tyro.cli(Serve, args=words),
    "roundel-camera": lambda words: tyro.cli(Publish, args=words),
    "roundel-web": lambda words: tyro.cli(ViewArena, args=words),
}
SERVICES = sorted((ROOT / "configs" / "systemd").glob("*.service"))


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.stem)
def test_a_service_starts_a_program_with_valid_options(path: Path):
    """A camera's options come from the example in the comment of the file."""
    unit = configparser.RawConfigParser(strict=False)  # systemd joins the lines of a repeated option
    unit.optionxform = str  # pyright: ignore[reportAttributeAccessIssue] as configparser documents it
    unit.read(path)
    program, *words = shlex.split(unit["Service"]["ExecStart"].replace("%i", "north"))
    if "$ROUNDEL_CAMERA" in words:
        (options,) = [
            line for line in path.read_text().splitlines() if line.startswith("#   ROUNDEL_CAMERA=")
        ]
        words = [*words[: words.index("$ROUNDEL_CAMERA")], *shlex.split(options.partition("=")[2])]
    assert Path(program).parent == Path("/opt/roundel/bin")
    PROGRAMS[Path(program).name](words)  # SystemExit if an option is unknown


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.stem)
def test_systemd_accepts_a_service(path: Path, tmp_path: Path):
    """`systemd-analyze verify` of a copy with an existing program."""
    copy = tmp_path / path.name
    copy.write_text(path.read_text().replace("ExecStart=/opt/roundel/bin/roundel-", "ExecStart=/bin/echo "))
    done = subprocess.run(
        ["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, timeout=60, check=False
    )
    assert path.name not in done.stderr, done.stderr
