# SPDX-License-Identifier: BSD-3-Clause
"""`fusion health` and `fusion doctor`: what an operator reads, and the exit codes that a monitoring system reads."""

import json
import shutil
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from calib.rig.rig import Rig
from fusion.diagnosis.findings import check_certificates, check_disk, check_listening, check_rig
from fusion.protocol.arena_health import assess_calibration
from fusion.server.arena_config import ArenaConfig
from tests.conftest import ROOT, free_port
from tests.fusion.arena_process import ARENA, cameras_at, saving
from tests.fusion.serving import ServerProcess
from tests.processes import run_program
from tests.security.lab import certificates
from tests.waiting import wait_for

NOW = datetime(2026, 11, 22, tzinfo=UTC)


def test_health_and_doctor_of_a_running_arena(tmp_path: Path):
    """Healthy while cameras send; with the names of all cameras once they stop."""
    with ServerProcess(saving(tmp_path)) as server:
        words = ("--connect", server.endpoint, "--arena", "test")
        with cameras_at(server.endpoint):
            wait_for(lambda: run_program("fusion", "health", *words).returncode == 0)
            done = run_program("fusion", "health", *words, "--json")
            state = json.loads(done.stdout)
            assert state["healthy"]
            assert state["robots"] == {"a": "tracked"}
            assert all(state["cameras"][name] for name in ARENA.cameras)
            checked = run_program(
                "fusion", "doctor", "--config", str(tmp_path / "arena.yaml"), "--connect", server.endpoint
            )
        wait_for(lambda: run_program("fusion", "health", *words).returncode == 1)
        silent = json.loads(run_program("fusion", "health", *words, "--json").stdout)
        assert {f"camera {name}: sends no frames" for name in ARENA.cameras} <= set(silent["problems"])
    assert "error" not in checked.stdout
    assert "ok      robot a: tracked" in checked.stdout
    assert "no date recorded" in checked.stdout


@pytest.mark.computed
def test_without_a_server_health_is_2_and_doctor_says_what_to_do(tmp_path: Path):
    nowhere = f"tcp/127.0.0.1:{free_port()}"
    done = run_program("fusion", "health", "--connect", nowhere, "--timeout-s", "0.5")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    checked = run_program("fusion", "doctor", "--connect", nowhere, "--timeout-s", "0.5")
    assert checked.returncode == 1
    assert "start it with roundel up or roundel server" in checked.stdout


def test_a_taken_port_and_an_absent_address_are_errors():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = (f"tcp/127.0.0.1:{taken.getsockname()[1]}", "tcp/192.0.2.1:7447", "tcp/127.0.0.1:0")
        findings = list(check_listening(ArenaConfig(listen=listen), is_reached=False))
    assert [finding.level for finding in findings] == ["error", "error", "ok"]
    assert all(finding.remedy for finding in findings[:2])


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
def test_certificates_that_expire_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """certificates.sh gives them one year, and their authority ten."""
    assert certificates(tmp_path, "localhost", "viewer").returncode == 0
    monkeypatch.chdir(tmp_path / "viewer")
    member, now = ROOT / "configs" / "zenoh" / "member.json5", datetime.now(UTC)
    for days, expected in ((0, ["ok", "ok"]), (350, ["ok", "warning"]), (400, ["ok", "error"])):
        findings = list(check_certificates(member, now + timedelta(days=days)))
        assert [finding.level for finding in findings] == expected, findings
    monkeypatch.chdir(tmp_path)
    assert {finding.level for finding in check_certificates(member, now)} == {"error"}


@pytest.mark.parametrize(
    ("calibration", "level"),
    [
        ({"grade": "A", "date": "2026-11-01T12:00:00+00:00"}, "ok"),
        ({"grade": "D", "date": "2026-11-01T12:00:00+00:00"}, "warning"),
        ({"grade": "B", "date": "2026-01-01T12:00:00"}, "warning"),
        ({"grade": 7, "date": []}, "ok"),  # written by hand: nothing is known
    ],
)
def test_age_and_grade_of_a_calibration(calibration: dict, level: str):
    assert check_rig(Rig(cameras=ARENA.cameras, calibration=calibration), NOW).level == level


def test_no_calibration_is_a_finding():
    assert check_rig(None, NOW).level == "warning"
    assert assess_calibration(None, NOW).placed == 0


def test_a_folder_without_the_right_to_write_is_found(tmp_path: Path):
    assert check_disk(tmp_path).state.endswith(str(tmp_path.resolve()))
