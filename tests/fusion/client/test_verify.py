# SPDX-License-Identifier: BSD-3-Clause
"""`roundel verify --live`: a rod of known length in a running arena."""

import json
import sys
from pathlib import Path

from camera_node.foundation.config import dump_yaml
from fusion.client.arena import Arena as Client
from tests.conftest import ROOT
from tests.fusion.carried_rod import LOOP_S, ROD
from tests.fusion.serving import REAL_TIME_MS, config, serving_process
from tests.processes import killed_at_end, run_program
from tests.waiting import DEADLINE_S, wait_for


def test_a_rod_in_a_running_arena(tmp_path: Path):
    """Server, cameras and command are programs; the server's rig is right, so the scale is 1."""
    (tmp_path / "rod.yaml").write_text(dump_yaml(ROD))
    with serving_process(config(tmp_path, lateness_ms=REAL_TIME_MS)) as (endpoint, _):
        cameras = [sys.executable, "-m", "tests.fusion.carried_rod", endpoint]
        with killed_at_end(cameras, cwd=ROOT), Client.connect(endpoint, arena="test") as client:
            wait_for(lambda: len(client.markers(DEADLINE_S).next()))
            words = ("--object", str(tmp_path / "rod.yaml"), "--live", "--seconds", str(LOOP_S), "--json")
            done = run_program("fusion", "verify", *words, "--connect", endpoint, "--arena", "test")
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads(done.stdout)
    assert report["used"] > 0
    assert abs(report["scale"] - 1) < 3 * report["scale_sigma"]
