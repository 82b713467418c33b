# SPDX-License-Identifier: BSD-3-Clause
"""`fusion health` and `fusion doctor`: what an operator reads, and the exit codes that a monitoring system reads."""

import contextlib
import json
import os
import shutil
import socket
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
import pytest

from calib.rig.rig import Rig, save_rig
from camera_node.protocol.messages import Detections
from fusion.client.arena import Arena as Client
from fusion.diagnosis.findings import check_certificates, check_disk, check_files, check_listening, check_rig
from fusion.model.robots import Robot, save_robots
from fusion.protocol.arena_health import assess_calibration, assess_health
from fusion.protocol.pose_messages import RobotsRequest
from fusion.server.arena_config import ArenaConfig
from fusion.server.server_statistics import LATE
from fusion.server.storage.active_rig import ActiveRig
from fusion.server.storage.active_robots import ActiveRobots
from tests.conftest import ROOT, free_port
from tests.fusion.arena_process import ARENA, cameras_at, saving
from tests.fusion.serving import ServerProcess
from tests.processes import run_program
from tests.security.lab import certificates
from tests.waiting import DEADLINE_S, wait_for

NOW = datetime(2026, 11, 22, tzinfo=UTC)


def said_by(command: str, code: int, *words: str) -> str:
    """The output of a command that ends with this exit code, else nothing."""
    done = run_program("fusion", command, *words)
    return done.stdout if done.returncode == code else ""


def without_error(checked: str) -> str:
    """The output of `doctor`; nothing where it has an error."""
    return "" if "error" in checked else checked


def problems_of(health: str) -> list[str]:
    """Of the output of `health --json`; none where it is empty."""
    return json.loads(health)["problems"] if health else []


def test_health_and_doctor_of_a_running_arena(tmp_path: Path):
    """Healthy while cameras send; with the names of all cameras once they stop.

    Each is asked until it is well: a busy machine loses frames for seconds, and says so.
    """
    with ServerProcess(saving(tmp_path)) as server:
        words = ("--connect", server.endpoint, "--arena", "test")
        doctor = ("--config", str(tmp_path / "arena.yaml"), "--connect", server.endpoint)
        with cameras_at(server.endpoint):
            state = wait_for(lambda: said_by("health", 0, *words, "--json"))
            assert json.loads(state)["healthy"]
            assert json.loads(state)["robots"] == {"a": "tracked"}
            assert all(json.loads(state)["cameras"][name] for name in ARENA.cameras)
            checked = wait_for(lambda: without_error(run_program("fusion", "doctor", *doctor).stdout))
        expected = {f"camera {name}: sends no frames" for name in ARENA.cameras}
        wait_for(lambda: expected <= set(problems_of(said_by("health", 1, *words, "--json"))))
    assert "ok      robot a: tracked" in checked
    assert "no date recorded" in checked


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


def test_the_files_that_the_server_uses_are_checked_whatever_their_times_are(tmp_path: Path):
    """Before: the rig that was modified last was judged, which after a copy is any one; saved robots never were."""
    given, saved = (
        Rig(cameras=ARENA.cameras, calibration={"grade": grade, "date": NOW.isoformat()}) for grade in "DA"
    )
    files = {n: str(tmp_path / f"{n}.yaml") for n in ("rig", "saved_rig", "robots", "saved_robots")}
    config = msgspec.convert(files, ArenaConfig)
    save_rig(given, Path(files["rig"]))
    save_robots(ARENA.robots, Path(files["robots"]))
    active, robots = (
        ActiveRig(Path(files["rig"]), Path(files["saved_rig"])),
        ActiveRobots(Path(files["robots"]), Path(files["saved_robots"])),
    )
    active.save(saved, 0)
    robots.change(RobotsRequest(rename={next(iter(ARENA.robots)): "rover"}))
    for newest in files.values():
        for file in files.values():
            os.utime(file, (0, 0))
        os.utime(newest)
        said = {finding.subject: finding for finding in check_files(config, NOW)}
        assert said["robots"].state.startswith("rover")
        assert said["calibration"].level == "ok", newest


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


def with_a_robot_elsewhere(folder: Path) -> ArenaConfig:
    """The settings of a server that also declares a robot, which is on no floor."""
    settings = saving(folder)
    ghost = Robot(diameter_m=0.12, markers=((0.2, 0.0, 0.0), (0.0, 0.3, 0.0), (-0.2, -0.1, 0.0)))
    robots = {"a": ARENA.robots["a"], "ghost": ghost}
    Path(settings.robots).write_bytes(msgspec.yaml.encode({"robots": msgspec.to_builtins(robots)}))
    return settings


@contextlib.contextmanager
def server_with_a_robot_elsewhere(folder: Path) -> Iterator[tuple[str, Callable[[], tuple[str, ...]]]]:
    """A server with a robot that is nowhere: its endpoint, and what its next status says."""
    folder.mkdir()
    with (
        ServerProcess(with_a_robot_elsewhere(folder)) as server,
        Client.connect(server.endpoint, arena="test") as client,
    ):
        yield (
            server.endpoint,
            lambda: assess_health(client.status(DEADLINE_S).next(), client.rig(), NOW).problems,
        )


@pytest.mark.ci
def test_what_is_missing_or_refused_is_no_health(tmp_path: Path):
    """A robot that was never found, a camera whose images have another size, and one whose stamps jump by a second
    while it is started again."""
    with server_with_a_robot_elsewhere(tmp_path / "server") as (endpoint, problems):
        with cameras_at(endpoint):
            wait_for(lambda: any(p.startswith("robot ghost was never found: ") for p in problems()))
            wait_for(lambda: not any(p.startswith("camera") for p in problems()))
        with cameras_at(endpoint, altered=smaller):
            wait_for(
                lambda: any(
                    "cam1: frames of the last 10 s" in p and "wrong image size" in p for p in problems()
                )
            )
        with cameras_at(endpoint, altered=delayed):
            wait_for(
                lambda: any(
                    p.startswith("camera cam2: its stamps are not known to better") for p in problems()
                )
            )


def test_frames_that_always_come_too_late_are_no_health(tmp_path: Path):
    with (
        server_with_a_robot_elsewhere(tmp_path / "server") as (endpoint, problems),
        cameras_at(endpoint, altered=delayed),
    ):
        wait_for(lambda: any("cam2: frames of the last 10 s" in p and LATE in p for p in problems()))


def smaller(message: Detections) -> Detections:
    """Of cam1, whose images have half of their width."""
    return msgspec.structs.replace(message, width=400) if message.camera == "cam1" else message


def delayed(message: Detections) -> Detections:
    """Of cam2, whose frames are sent a second after they were taken."""
    if message.camera != "cam2":
        return message
    return msgspec.structs.replace(message, t_ns=message.t_ns - 10**9, sent_ns=message.sent_ns - 10**9)
