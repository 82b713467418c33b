# SPDX-License-Identifier: BSD-3-Clause
"""The command `detect`."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from camera_node.commands.detect import Detect
from camera_node.foundation.errors import CameraError, ConfigError
from tests.benchmarks.detector.pictures import Card, render
from tests.camera_node.tracing import expose


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "frame.png"
    cv2.imwrite(str(path), expose(render([Card((80, 60), 40, 0.5)]), 2, np.random.default_rng(1)))
    return path


def test_json_has_one_object_for_each_image(image: Path, capsys: pytest.CaptureFixture[str]):
    assert Detect(images=(image, image), json=True).run() == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["file"] for line in lines] == [str(image)] * 2
    (roundel,) = lines[0]["roundels"]
    assert roundel["id"] is None
    assert roundel["u"] == pytest.approx(80, abs=0.5)
    assert {"v", "cov_uu", "cov_uv", "cov_vv", "major_px", "minor_px", "angle_rad", "contrast"} <= set(
        roundel
    )
    assert "poses" not in roundel


def test_a_rig_adds_both_poses(image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rig = tmp_path / "rig.yaml"
    rig.write_text("cameras: {cam0: {width: 160, height: 120, fx: 600, fy: 600, cx: 79.5, cy: 59.5}}\n")
    Detect(images=(image,), json=True, rig=rig, name="cam0", diameter=0.14).run()
    (roundel,) = json.loads(capsys.readouterr().out)["roundels"]
    assert roundel["centre_u"] == pytest.approx(80, abs=0.1)
    assert len(roundel["poses"]) == 2
    assert roundel["poses"][0]["position_m"][2] == pytest.approx(0.14 * 600 / 40, rel=0.01)


def test_a_table_and_a_drawing(image: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    Detect(images=(image,), draw=tmp_path / "out.png").run()
    assert f"{image}: 1 roundel\n" in capsys.readouterr().out
    drawn = cv2.imread(str(tmp_path / "out.png"))
    assert drawn is not None
    assert (drawn.max(axis=2) != drawn.min(axis=2)).any()


def test_contradictory_options_are_refused(image: Path, tmp_path: Path):
    with pytest.raises(ConfigError, match="name a folder"):
        Detect(images=(image, image), draw=image).run()
    with pytest.raises(ConfigError, match="--diameter"):
        Detect(images=(image,), name="cam0").run()
    with pytest.raises(ConfigError, match="can't be written"):
        Detect(images=(image,), draw=tmp_path / "missing" / "out.png").run()


def test_an_error_names_the_file_that_is_no_image(tmp_path: Path):
    (tmp_path / "notes.txt").write_text("no image")
    with pytest.raises(CameraError, match=r"notes\.txt is not an image"):
        Detect(images=(tmp_path / "notes.txt",)).run()
