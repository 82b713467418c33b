# SPDX-License-Identifier: BSD-3-Clause
"""The printed sheet: the detector finds the roundels that a browser renders from it."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from camera_node.commands.print import Sheet, draw
from camera_node.detection.detector import Detector
from camera_node.errors import ConfigError
from camera_node.sources.replay import read_grey

PX_PER_MM = 96 / 25.4  # CSS


def test_roundels_on_a_sheet_have_the_requested_size(tmp_path: Path):
    """A browser's image of the sheet, at 96 pixels per inch, shows every roundel with its diameter and ratio."""
    if (chromium := shutil.which("chromium")) is None:
        pytest.skip("chromium is not installed")
    sheet = tmp_path / "sheet.svg"
    text, count = draw(Sheet(sheet, diameter=0.05))
    sheet.write_text(text)
    flags = "--headless --no-sandbox --disable-gpu --disable-background-networking --window-size=794,1123"
    picture = tmp_path / "sheet.png"
    places = [f"--screenshot={picture}", f"--user-data-dir={tmp_path / 'profile'}", sheet.as_uri()]
    subprocess.run([chromium, *flags.split(), *places], check=True, timeout=60, capture_output=True)
    found = Detector().detect(read_grey(picture))
    assert len(found) == count == 12
    # The browser draws curves as chords within an eighth of a pixel, which is a quarter for a diameter.
    assert abs(found.axes_px - 50 * PX_PER_MM).max() < 0.25
    assert abs(found.ratio - 0.6).max() < 0.002


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"diameter": 0.5}, "643 mm does not fit on a4"),
        ({"diameter": -1.0}, "diameter_m is -1"),
        ({"paper": "a9"}, "choose one of a4, a3, letter"),
    ],
)
def test_impossible_sheets_are_refused(settings: dict, message: str):
    with pytest.raises(ConfigError, match=message):
        draw(Sheet(Path("x.svg"), **settings))


def test_the_command_writes_the_sheet(tmp_path: Path):
    """`print` reports the number and size of the roundels; a missing folder gives one line and exit code 2."""
    command = [sys.executable, "-m", "camera_node", "print"]
    done = subprocess.run([*command, str(tmp_path / "a.svg")], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0
    assert "1 roundel of d_o = 120 mm" in done.stdout
    done = subprocess.run([*command, str(tmp_path / "no/a.svg")], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert "Traceback" not in done.stderr
