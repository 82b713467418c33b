# SPDX-License-Identifier: BSD-3-Clause
"""`roundel camera --list` and `--check`, and the commands of docs/cameras.md."""

import json
import re
import shlex
from pathlib import Path

import cv2
import numpy as np
import pytest
import tyro

from camera_node.commands.camera_check import check_camera
from camera_node.commands.camera_command import JoinArena
from camera_node.foundation.errors import ConfigError
from camera_node.sources.frame import SourceSettings
from tests.benchmarks.detector.pictures import Card, render
from tests.conftest import ROOT

PERIOD_NS = 20_000_000


def write_frames(folder: Path, stamps: list[int], light: float = 1.0) -> str:
    """A folder of frames with one roundel in the middle; its path."""
    folder.mkdir()
    image = np.rint(light * render([Card((80.0, 60.0), 30, 0.5, 0.7)])).astype(np.uint8)
    for t_ns in stamps:
        cv2.imwrite(str(folder / f"{t_ns}.png"), image)
    return str(folder)


def regular(count: int = 40) -> list[int]:
    return [10**18 + k * PERIOD_NS for k in range(count)]


def test_a_camera_in_order_has_no_fault(tmp_path: Path):
    report = check_camera(write_frames(tmp_path / "good", regular()), SourceSettings(pace="fast"), 10.0)
    assert report.faults == ()
    assert report.fps == pytest.approx(50.0)
    assert (report.frames, report.missing, report.out_of_order, report.roundels) == (40, 0, 0, 1)
    assert report.jitter_ms == pytest.approx(0.0, abs=1e-3)
    assert report.edge_blur_px is not None
    assert report.edge_blur_px < 1


def test_each_fault_is_named(tmp_path: Path):
    """Every tenth frame is missing, stamps are off by up to 3 ms, and the paper is dark."""
    rng = np.random.default_rng(8)
    stamps = [t + int(rng.integers(-3_000_000, 3_000_000)) for k, t in enumerate(regular(60)) if k % 10 != 5]
    report = check_camera(
        write_frames(tmp_path / "bad", stamps, light=0.2), SourceSettings(pace="fast"), 10.0
    )
    assert report.missing == 6
    text = " ".join(report.faults)
    assert all(part in text for part in ("stamps vary by", "6 frames are lost", "too dark"))


def test_the_check_is_a_command(tmp_path: Path, capsys: pytest.CaptureFixture):
    """Its exit code and its JSON say whether there is a fault."""
    good = write_frames(tmp_path / "good", regular())
    bad = write_frames(tmp_path / "bad", regular(5))
    words = ["--check", "--source", good, bad, "--pace", "fast"]
    assert tyro.cli(JoinArena, args=words).run() == 1
    text = capsys.readouterr().out
    assert "in order" in text
    assert "FAULT: only 5 frames" in text
    assert tyro.cli(JoinArena, args=["--check", "--json", "--source", good, "--pace", "fast"]).run() == 0
    (report,) = json.loads(capsys.readouterr().out)
    assert report["fps"] == pytest.approx(50.0)
    with pytest.raises(ConfigError, match="--json prints"):
        tyro.cli(JoinArena, args=["--json"]).run()


def test_the_list_has_every_driver_or_its_reason(capsys: pytest.CaptureFixture):
    """This machine has no camera; a driver whose library is missing says what to install."""
    code = tyro.cli(JoinArena, args=["--list", "--json"]).run()
    assert (code == 0) == bool(json.loads(capsys.readouterr().out))
    if code:
        tyro.cli(JoinArena, args=["--list"]).run()
        assert "picamera: a camera of a Raspberry Pi needs picamera2" in capsys.readouterr().out


def test_the_commands_of_the_page_are_valid():
    text = (ROOT / "docs" / "cameras.md").read_text()
    lines = [line for block in re.findall(r"```sh\n(.*?)```", text, re.DOTALL) for line in block.splitlines()]
    parsed = [tyro.cli(JoinArena, args=shlex.split(line)[2:]) for line in lines]
    assert [camera.check for camera in parsed].count(True) == 1
    for camera in parsed:
        camera.settings.check()
    assert parsed[-1].settings.controls == ("SyncMode=Client",)
