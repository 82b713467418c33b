# SPDX-License-Identifier: BSD-3-Clause
"""From four unknown cameras to poses in a program: two commands and clicks in a real browser, and no edited file."""

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from tests.benchmarks.faults.network import Namespaces, why_not
from tests.web.browser import CHROMIUM
from tests.web.roundel.first_arena import CAMERAS, CENTRE_M, FPS, RADIUS_M, ROUND_S, FirstArena, play, render


@pytest.mark.slow  # the recording lasts three minutes
def test_from_unknown_cameras_to_poses_with_two_commands_and_the_page(tmp_path: Path):
    """The server with two cameras, and two cameras on another machine, which finds the server by scouting.

    The robot drives on a circle whose radius, duration and place in the world of the L-frame the poses show. The
    largest error that the calibration states bounds the radius; the distances of single poses from the circle have
    noise of their own, half a pixel.
    """
    if CHROMIUM is None:
        pytest.skip("chromium is not installed; apt-get install chromium")
    if reason := why_not():
        pytest.skip(reason)
    render(tmp_path / "recording")
    with Namespaces([CAMERAS]) as network, FirstArena(network, tmp_path / "recording", tmp_path) as arena:
        outcome = play(arena, tmp_path, lambda page, name: None)
        assert arena.camera.stop() == 0
        assert arena.up.stop() == 0
    assert re.search("found arena 'arena' at tcp/", arena.camera.text)
    assert outcome.clicks - outcome.repeated <= MAX_CLICKS
    assert outcome.seconds < MAX_S * arena.times
    assert abs(outcome.circle.radius_m - RADIUS_M) < 1e-3 * outcome.expected_mm
    # The L-frame's roundels, which fix the origin, have the same errors as the robot's.
    assert np.linalg.norm(outcome.circle.centre_m - CENTRE_M) < 2e-3 * outcome.expected_mm
    assert outcome.circle.rms_m < 1e-3 * (outcome.expected_mm + PIXEL_MM / 2)
    assert abs(outcome.circle.round_s - ROUND_S) < 0.01 * ROUND_S
    lab = tmp_path / "lab"
    assert {path.stem for path in (lab / "cameras").glob("*.yaml")} == set(FPS)
    assert list(yaml.safe_load((lab / "robots.yaml").read_text())["robots"]) == ["rover"]


MAX_CLICKS, MAX_S = 15, 300.0  # the goals of the first hour; the motions last longer on a loaded machine
PIXEL_MM = 1e3 * 3.0 / 565.0  # at 3 m
