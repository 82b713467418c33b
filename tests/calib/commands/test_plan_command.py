# SPDX-License-Identifier: BSD-3-Clause
"""`roundel plan` as a process: text, JSON, reports, suggestions, rigs and mistakes."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from calib.plan.catalogue import CATALOGUE
from calib.plan.description import Plan
from calib.rig.rig import Rig, save_rig
from camera_node.config import load_yaml
from tests.conftest import ROOT

SHIPPED = ROOT / "configs" / "plan.yaml"


def plan(*options: str | Path, expected: int = 0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "calib", "plan", *map(str, options)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == expected, done.stderr
    assert "Traceback" not in done.stderr
    return done


def test_the_shipped_plan_as_text_and_as_a_page(tmp_path: Path):
    page = tmp_path / "plan.html"
    text = plan(SHIPPED, "--report", page).stdout
    assert f"north: level roundels of {load_yaml(SHIPPED, Plan).robots.diameter_m:g} m from" in text
    covered = re.search(r"two cameras or more see (\d+)% of the area", text)
    assert covered is not None
    assert int(covered[1]) >= 90
    html = page.read_text()
    assert html.count("data:image/png;base64,") == 3
    assert "http" not in html.replace("http-equiv", "")  # self-contained
    assert "north" in html


def test_the_result_of_a_rig_as_json_and_pdf(tmp_path: Path):
    """A calibrated rig needs no plan: the floor under its cameras is evaluated."""
    cameras = {name: camera.camera() for name, camera in load_yaml(SHIPPED, Plan).cameras.items()}
    save_rig(Rig(cameras=cameras), tmp_path / "rig.yaml")
    pdf = tmp_path / "plan.pdf"
    result = json.loads(plan("--rig", tmp_path / "rig.yaml", "--json", "--report", pdf).stdout)
    assert set(result["cameras"]) == set(cameras)
    assert 0.3 < result["covered"] < result["covered"] + result["single"] <= 1.0
    grid = result["grid"]
    assert len(grid["error_mm"]) == len(grid["x_m"]) * len(grid["y_m"]) * len(grid["z_m"])
    assert pdf.read_bytes().startswith(b"%PDF")


def test_a_suggested_plan_can_be_evaluated(tmp_path: Path):
    out = tmp_path / "suggested.yaml"
    text = SHIPPED.read_text()
    only_wall = text[: text.index("    south wall")]
    (tmp_path / "plan.yaml").write_text(only_wall)
    said = plan(tmp_path / "plan.yaml", "--suggest", "2", "--out", out).stdout
    assert "camera-2: at " in said
    assert set(load_yaml(out, Plan).cameras) == {"camera-1", "camera-2"}
    again = plan(out).stdout
    assert [line for line in said.splitlines() if "level" in line] == [
        line for line in again.splitlines() if "level" in line
    ]


def test_the_catalogue_is_listed():
    lines = plan("--catalogue").stdout.splitlines()
    assert [line.split()[0] for line in lines] == list(CATALOGUE)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "give a plan such as"),
        ((SHIPPED, "--suggest", "0"), "give 1 to"),
        ((SHIPPED, "--out", "x.yaml"), "give --suggest N"),
        ((SHIPPED, "--report", "plan.doc"), "neither .html nor .pdf"),
        ((SHIPPED, "--report", "missing/plan.pdf"), "is not a folder"),
    ],
)
def test_mistakes_are_named_in_one_line(options: tuple, message: str):
    error = plan(*options, expected=2).stderr
    assert message in error
    assert len(error.strip().splitlines()) == 1
