# SPDX-License-Identifier: BSD-3-Clause
"""Surveyed positions are read from CSV and YAML; errors name the file and the line."""

from pathlib import Path

import pytest

from calib.world.survey import read_positions
from camera_node.foundation.errors import ConfigError


def test_positions_are_read_from_yaml_and_csv(tmp_path: Path):
    (tmp_path / "points.yaml").write_text("a: [0, 1, 2]\nb: [3.5, 4, 5]\n")
    assert read_positions(tmp_path / "points.yaml")["b"] == pytest.approx([3.5, 4, 5])
    (tmp_path / "points.csv").write_text("name,x,y,z\na,0,1,2\n")
    assert list(read_positions(tmp_path / "points.csv")) == ["a"]
    (tmp_path / "points.yaml").write_text("a: [0, 1]\n")
    with pytest.raises(ConfigError, match=r"points\.yaml: "):
        read_positions(tmp_path / "points.yaml")


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("camera,x,y\n", "column z"),
        ("camera,x,y,z\na,1,2,up\n", "line 2"),
        ("camera,x,y,z\na,1,2,3\na,1,2,3\n", "'a' twice"),
    ],
)
def test_a_broken_survey_is_refused(tmp_path: Path, text: str, fault: str):
    path = tmp_path / "survey.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=fault):
        read_positions(path)
