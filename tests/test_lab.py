# SPDX-License-Identifier: BSD-3-Clause
"""The systemd services of configs/systemd, and the devices that they may open."""

import configparser
import fnmatch
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest
import tyro

from camera_node.commands.publish import Publish
from camera_node.foundation.errors import USER_ERROR
from fusion.commands.serve import Serve
from tests.conftest import ROOT
from web.roundel.serve_page import ViewArena

PROGRAMS: dict[str, Callable[[list[str]], object]] = {
    "roundel-fusion": lambda words: tyro.cli(Serve, args=words),
    "roundel-camera": lambda words: tyro.cli(Publish, args=words),
    "roundel-web": lambda words: tyro.cli(ViewArena, args=words),
}
UNITS = ROOT / "configs" / "systemd"
SERVICES = sorted(UNITS.glob("*.service"))
# Each service, and the one of cameras with what each kind of camera adds to it.
INSTALLED = [
    *((path, None) for path in SERVICES),
    *((UNITS / "roundel-camera@.service", path) for path in sorted((UNITS / "devices").glob("*.conf"))),
]
EXPOSURE = 14  # tenths; of `systemd-analyze security`, which calls 0 to 2.0 "safe" or "OK"
needs_systemd = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed"
)


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


@needs_systemd
@pytest.mark.parametrize(
    ("path", "devices"),
    INSTALLED,
    ids=[f"{path.stem} {d.stem if d else ''}".strip() for path, d in INSTALLED],
)
def test_a_service_is_valid_and_has_few_rights(path: Path, devices: Path | None, tmp_path: Path):
    """By the measure of `systemd-analyze security`; without the hardening it is above 8."""
    copy = tmp_path / path.name
    copy.write_text(path.read_text().replace("ExecStart=/opt/roundel/bin/roundel-", "ExecStart=/bin/echo "))
    if devices is not None:
        folder = tmp_path / f"{path.name}.d"
        folder.mkdir()
        shutil.copy(devices, folder)
    for words in (["verify", "--man=no"], ["security", "--offline=yes", f"--threshold={EXPOSURE}"]):
        command = ["systemd-analyze", *words, str(copy)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
        assert done.returncode == 0, done.stdout[-300:] + done.stderr
        assert str(tmp_path) not in done.stderr, done.stderr  # an unknown setting is a warning
    text = path.read_text()
    assert f"RestartPreventExitStatus={USER_ERROR}\n" in text
    assert "Type=notify\n" in text
    assert "WatchdogSec=" in text


def test_the_rule_of_usb_cameras_matches_their_class_only():
    """The interfaces of a USB3 Vision camera and of a webcam, as udev's `usb_id` lists them."""
    rule = (UNITS / "devices" / "60-roundel-usb3-vision.rules").read_text()
    pattern = rule.partition('ENV{ID_USB_INTERFACES}=="')[2].partition('"')[0]
    assert fnmatch.fnmatchcase(":ef0500:ef0501:ef0502:", pattern)
    assert not fnmatch.fnmatchcase(":0e0100:0e0200:010100:", pattern)
