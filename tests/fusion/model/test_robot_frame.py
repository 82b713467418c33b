# SPDX-License-Identifier: BSD-3-Clause
"""A robot's own frame can be changed; the markers stay where they are in the world."""

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from camera_node.foundation.errors import ConfigError
from camera_node.protocol.server_connection import Connection
from fusion.commands.edit_robots import robots
from fusion.errors import FusionError
from fusion.model.robots import DECIMALS, MAX_PIVOT_M, load_robots, move_origin, turn_heading
from tests.conftest import ROOT
from tests.fusion.serving import config, serving
from tests.fusion.synthetic import TRIANGLE

CUBE = load_robots(ROOT / "configs" / "robots_cube.yaml")["cube"]
ROUNDING_M = 2 * 10**-DECIMALS
METRES = st.floats(-MAX_PIVOT_M, MAX_PIVOT_M)


def pairs(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - points, axis=2)


@given(st.tuples(METRES, METRES, METRES), st.floats(-720, 720))
def test_a_change_of_frame_is_a_rigid_motion(pivot: tuple[float, float, float], degrees: float):
    changed = turn_heading(move_origin(TRIANGLE, pivot), degrees)
    assert np.abs(pairs(changed.points) - pairs(TRIANGLE.points)).max() <= 2 * ROUNDING_M
    assert (changed.diameter_m, changed.motion) == (TRIANGLE.diameter_m, TRIANGLE.motion)


@given(st.floats(-720, 720))
def test_normals_turn_with_the_markers(degrees: float):
    """Of a cube: the angle between each normal and the direction to each other marker stays the same."""
    changed = turn_heading(move_origin(CUBE, (0.1, 0.0, 0.2)), degrees)
    before, after = (
        np.einsum("mki,mi->mk", body.points - body.points[:, None], body.unit_normals)
        for body in (CUBE, changed)
    )
    assert np.abs(after - before).max() <= 2 * ROUNDING_M


def test_the_new_origin_is_at_the_pivot():
    """A pivot at a marker has that marker at the origin."""
    changed = move_origin(TRIANGLE, TRIANGLE.markers[1])
    assert np.abs(changed.points[1]).max() == 0.0


def test_the_new_x_axis_is_turned_counterclockwise():
    """The old x axis has the angle minus 30 degrees in the new frame."""
    p = turn_heading(TRIANGLE, 30.0).points
    old = np.array(TRIANGLE.points)
    angle = np.arctan2(p[:, 1], p[:, 0]) - np.arctan2(old[:, 1], old[:, 0])
    off = np.linalg.norm(old[:, :2], axis=1) > 0.05
    np.testing.assert_allclose(np.angle(np.exp(1j * angle[off])), -math.radians(30), atol=1e-3)
    assert (p[:, 2] == old[:, 2]).all()


@given(st.floats(-720, 720))
def test_turning_back_restores_the_robot(degrees: float):
    there_and_back = turn_heading(turn_heading(TRIANGLE, degrees), -degrees)
    assert np.abs(there_and_back.points - TRIANGLE.points).max() <= 2 * ROUNDING_M


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e9])
def test_impossible_changes_are_refused(bad: float):
    with pytest.raises(FusionError):
        move_origin(TRIANGLE, (bad, 0.0, 0.0))
    if not math.isfinite(bad):
        with pytest.raises(FusionError):
            turn_heading(TRIANGLE, bad)


def test_the_commands_change_the_running_server(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """Pivot and turn; an unknown robot is refused with the known names, and so is a word for a number."""
    with serving(config(tmp_path)) as (server, client):
        connection = Connection(connect=tuple(server.endpoints), arena="test")
        robots("pivot", ("a", "0.1", "0", "0"), connection=connection)
        robots("turn", ("a", "90"), connection=connection)
        assert client.declared_robots().robots["a"] == turn_heading(
            move_origin(TRIANGLE, (0.1, 0.0, 0.0)), 90.0
        )
        with pytest.raises(FusionError, match="no robot 'b'; there are a"):
            robots("turn", ("b", "90"), connection=connection)
        with pytest.raises(ConfigError, match="give numbers"):
            robots("turn", ("a", "left"), connection=connection)


def test_the_commands_list_save_rename_and_remove_robots(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with serving(config(tmp_path)) as (server, client):
        connection = Connection(connect=tuple(server.endpoints), arena="test")
        out = tmp_path / "saved.yaml"
        robots("list", connection=connection)
        assert capsys.readouterr().out == "a: 3 markers of 0.12 m\n"
        robots("save", (str(out),), connection=connection)
        assert load_robots(out) == {"a": TRIANGLE}
        with pytest.raises(ConfigError, match="exists; add --force"):
            robots("save", (str(out),), connection=connection)
        robots("rename", ("a", "cart"), connection=connection)
        assert client.declared_robots().robots == {"cart": TRIANGLE}
        robots("remove", ("cart",), connection=connection)
        assert client.declared_robots().robots == {}
        with pytest.raises(ConfigError, match="use roundel robots rename OLD NEW"):
            robots("rename", ("a",), connection=connection)
