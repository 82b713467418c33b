# SPDX-License-Identifier: BSD-3-Clause
"""`roundel plan` as a command: text, JSON, reports, suggestions, rigs and mistakes."""

import json
import re
from pathlib import Path

import pytest

from calib.commands.plan import PlanArena
from calib.plan import placement
from calib.plan.catalogue import CATALOGUE
from calib.plan.description import Plan
from calib.rig.rig import Rig, save_rig
from camera_node.foundation.command_line import parse
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import ConfigError
from tests.conftest import ROOT
from tests.processes import run_program

SHIPPED = ROOT / "configs" / "plan.yaml"


def plan(*options: str | Path) -> str:
    done = run_program("calib", "plan", *options)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_shipped_plan_as_text_and_as_a_page(tmp_path: Path):
    page = tmp_path / "plan.html"
    text = plan(SHIPPED, "--report", page)
    assert f"north: level roundels of {load_yaml(SHIPPED, Plan).robots.diameter_m:g} m from" in text
    covered = re.search(r"two cameras or more see (\d+)% of the area", text)
    assert covered is not None
    assert int(covered[1]) >= 90
    html = page.read_text()
    assert html.count("data:image/png;base64,") == 3
    assert "http" not in html.replace("http-equiv", "")  # self-contained
    assert "north" in html


@pytest.mark.ci
def test_the_result_of_a_rig_as_json_and_pdf(tmp_path: Path):
    """A calibrated rig needs no plan: the floor under its cameras is evaluated."""
    cameras = {name: camera.camera() for name, camera in load_yaml(SHIPPED, Plan).cameras.items()}
    save_rig(Rig(cameras=cameras), tmp_path / "rig.yaml")
    pdf = tmp_path / "plan.pdf"
    result = json.loads(plan("--rig", tmp_path / "rig.yaml", "--json", "--report", pdf))
    assert set(result["cameras"]) == set(cameras)
    assert 0.3 < result["covered"] < result["covered"] + result["single"] <= 1.0
    grid = result["grid"]
    assert len(grid["error_mm"]) == len(grid["x_m"]) * len(grid["y_m"]) * len(grid["z_m"])
    assert pdf.read_bytes().startswith(b"%PDF")


def test_a_suggested_plan_can_be_evaluated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys):
    """With a smaller search than the command's; the written plan has the result that was printed."""
    for name, value in {"PLACES": 6, "AIMS": 3, "STARTS": 1}.items():
        monkeypatch.setattr(placement, name, value)
    out = tmp_path / "suggested.yaml"
    parse(PlanArena, "roundel plan", [str(SHIPPED), "--suggest", "2", "--out", str(out)]).run()
    said = capsys.readouterr().out.splitlines()
    assert said[1].startswith("camera-2: at ")
    assert set(load_yaml(out, Plan).cameras) == {"camera-1", "camera-2"}
    parse(PlanArena, "roundel plan", [str(out)]).run()
    assert capsys.readouterr().out.splitlines() == said[3:]


def test_the_catalogue_is_listed(capsys: pytest.CaptureFixture[str]):
    parse(PlanArena, "roundel plan", ["--catalogue"]).run()
    lines = capsys.readouterr().out.splitlines()
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
def test_mistakes_are_named(options: tuple, message: str):
    """Before any work; `camera_node.foundation.errors.run` makes one line and exit code 2 of them."""
    with pytest.raises(ConfigError, match=re.escape(message)):
        parse(PlanArena, "roundel plan", [str(option) for option in options]).run()
