# SPDX-License-Identifier: BSD-3-Clause
"""Checks this machine and the files of an arena, and a running one: its server, its cameras and their clocks."""

import errno
import os
import re
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import msgspec
import zenoh

from calib.rig.rig import MAX_CAMERAS, Rig, load_rig
from camera_node.foundation.errors import RoundelError
from camera_node.protocol.messages import CameraStatus
from fusion.client.arena import Arena
from fusion.protocol.arena_health import (
    assess_calibration,
    calibration_problems,
    camera_problems,
    describe_calibration,
    describe_contradiction,
)
from fusion.protocol.installation import PACKAGES, installation
from fusion.protocol.pose_messages import FusionStatus
from fusion.server.arena_config import ArenaConfig
from fusion.server.storage.active_rig import ActiveRig
from fusion.server.storage.active_robots import ActiveRobots

CERTIFICATES = ("root_ca_certificate", "listen_certificate", "connect_certificate")
RENEW_DAYS = 30
MIN_FREE_GB = 2.0
INSTALL = "install it with python -m pip install '.[server]'"
RENEW = "renew it as docs/security.md describes"
LISTEN_S = 2.5  # at least two statuses of every camera
MAX_CLOCK_ERROR_MS = 1.0  # a robot at 1 m/s moves 1 mm in this time
SKIPPED = "late: a slow network or machine; refused: see docs/troubleshooting.md"
REMEDIES = {
    "sends no frames": "check its program: journalctl -u roundel-camera@NAME",
    "is not calibrated": "calibrate it: roundel calibrate wand --live --only NAME",
    "repeats an old image": "restart its node, or replug the camera",
    "was moved and is excluded": "drive a robot through its view, or calibrate it again",
    "two nodes use its name": "give each node a --name of its own",
}


class Finding(msgspec.Struct, frozen=True):
    """One check: its subject, the state in words, and what to do about it; empty where all is well."""

    level: Literal["ok", "warning", "error"]
    subject: str
    state: str
    remedy: str = ""

    @property
    def line(self) -> str:
        return f"{self.level:7} {self.subject}: {self.state}" + (f"; {self.remedy}" if self.remedy else "")


def check_versions() -> Finding:
    """The versions of Python and of the packages that a server needs."""
    made = installation()
    missing = [package for package in PACKAGES if package not in made.packages]
    if missing:
        return Finding("error", "versions", f"{', '.join(missing)} is missing", INSTALL)
    found = (f"{package} {number}" for package, number in made.packages.items())
    return Finding("ok", "versions", ", ".join((f"Python {made.python}", *found)))


def check_listening(config: ArenaConfig, is_reached: bool) -> Iterator[Finding]:
    """Whether a server can listen on its endpoints, or does so already (`is_reached`)."""
    for endpoint in config.listen:
        match = re.search(r"/\[?([^\]/]+)\]?:(\d+)", endpoint)
        if match is None:
            yield Finding("warning", "ports", f"{endpoint} is not checked: it has no port")
            continue
        if is_reached:
            yield Finding("ok", "ports", f"the server answers at {endpoint}")
            continue
        yield _check_address(endpoint, match[1], int(match[2]))


def _check_address(endpoint: str, host: str, port: int) -> Finding:
    try:
        with socket.create_server((host, port)):
            return Finding("ok", "ports", f"{endpoint} is free")
    except OSError as error:
        remedies = {
            errno.EADDRINUSE: "stop the program that uses it (ss -ltnp shows it), or change listen in arena.yaml",
            errno.EADDRNOTAVAIL: "use an address of this machine (ip address shows them), or 0.0.0.0",
            errno.EACCES: "use a port above 1023",
        }
        reason = os.strerror(error.errno) if error.errno and error.errno > 0 else str(error)
        return Finding(
            "error", "ports", f"{endpoint}: {reason}", remedies.get(error.errno or 0, "change listen")
        )


def check_certificates(zenoh_config: Path | None, now: datetime) -> Iterator[Finding]:
    """When the certificates of a Zenoh configuration expire; their paths start from the working folder."""
    if zenoh_config is None:
        yield Finding(
            "ok", "certificates", "none: everybody who reaches the port is trusted, see docs/security.md"
        )
        return
    try:
        config = zenoh.Config.from_file(str(zenoh_config))
    except zenoh.ZError as error:
        yield Finding("error", "certificates", f"{zenoh_config} is invalid: {error}", "correct the file")
        return
    names = (config.get_json(f"transport/link/tls/{name}").strip('"') for name in CERTIFICATES)
    for path in dict.fromkeys(Path(name) for name in names if name not in ("null", "")):
        yield _check_certificate(path, now)


def _check_certificate(path: Path, now: datetime) -> Finding:
    command = ["openssl", "x509", "-noout", "-enddate", "-in", str(path)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
        text = done.stdout.strip().removeprefix("notAfter=")
        left = datetime.strptime(text, "%b %d %H:%M:%S %Y %Z").replace(tzinfo=UTC) - now
    except FileNotFoundError:
        return Finding("warning", "certificates", f"{path} is not checked", "install openssl")
    except (subprocess.SubprocessError, ValueError):
        return Finding(
            "error", "certificates", f"{path} is missing or is no certificate", "create it: docs/security.md"
        )
    if left.days < 0:
        return Finding("error", "certificates", f"{path} expired {-left.days} days ago", RENEW)
    level = "warning" if left.days < RENEW_DAYS else "ok"
    return Finding(
        level, "certificates", f"{path} expires in {left.days} days", RENEW if level != "ok" else ""
    )


def check_disk(folder: Path) -> Finding:
    """The space for recordings and saved files."""
    free_gb = shutil.disk_usage(folder).free / 1e9
    state = f"{free_gb:.1f} GB free in {folder.resolve()}"
    if not os.access(folder, os.W_OK):
        return Finding(
            "error", "disk", f"{folder.resolve()} is not writable", "give this user the right to write there"
        )
    if free_gb < MIN_FREE_GB:
        return Finding("warning", "disk", state, "delete old recordings")
    return Finding("ok", "disk", state)


def check_files(config: ArenaConfig, now: datetime) -> Iterator[Finding]:
    """The rig and the robots that a server with this configuration loads."""
    given, saved_rig, saved_robots = (
        Path(file) if file else None for file in (config.rig, config.saved_rig, config.saved_robots)
    )
    try:
        robots = ActiveRobots(Path(config.robots), saved_robots).robots
        yield Finding("ok", "robots", ", ".join(robots) or "none")
    except RoundelError as error:
        yield Finding("error", "robots", str(error))
    rig = next(ActiveRig(given, saved_rig).saved_rigs(), given)
    if rig is None:
        yield check_rig(None, now)
        return
    try:
        yield check_rig(load_rig(rig), now)
    except RoundelError as error:
        yield Finding("error", "calibration", str(error))


def check_rig(rig: Rig | None, now: datetime) -> Finding:
    """The age and the grade of a rig."""
    calibration = assess_calibration(rig, now)
    state = describe_calibration(calibration)
    if problems := calibration_problems(calibration):
        return Finding("warning", "calibration", state, "; ".join(problems))
    return Finding("ok", "calibration", f"{calibration.placed} cameras, {state}")


@dataclass(frozen=True)
class Observation:
    """What a running arena reports in a few seconds."""

    status: FusionStatus
    cameras: Mapping[str, CameraStatus]
    rig: Rig | None


def observe(arena: Arena, timeout_s: float) -> Observation:
    """Receive the statuses of the server and the cameras. Raises NetworkError, with the cause, if none arrive."""
    cameras: dict[str, CameraStatus] = {}

    def keep(status: CameraStatus) -> None:
        if len(cameras) < MAX_CAMERAS:
            cameras[status.camera] = status

    arena.camera_statuses().on_message(keep)
    end_s = time.monotonic() + LISTEN_S
    status = arena.status(timeout_s).next()
    while time.monotonic() < end_s:
        status = arena.status(timeout_s).next()
    return Observation(status, cameras, arena.rig(timeout_s))


def check_arena(observation: Observation, now: datetime) -> Iterator[Finding]:
    """The cameras, their clocks, the robots and the rig in force."""
    status = observation.status
    yield from _check_cameras(status)
    for name, camera in sorted(observation.cameras.items()):
        yield _check_clock(name, camera)
    yield check_rig(observation.rig, now)
    for name, state in status.robots.items():
        remedy = "" if state == "tracked" else "check that cameras see it, and its markers: roundel define"
        yield Finding("warning" if remedy else "ok", f"robot {name}", state, remedy)
    for name, cause in status.not_acquired.items():
        if name not in status.robots:
            yield Finding("warning", f"robot {name}", "never found", cause)
    for contradiction in status.contradictions:
        state, remedy = describe_contradiction(contradiction).rsplit("; ", 1)
        yield Finding("warning", "claims", state, remedy)
    for name, diameter_m in status.measured_diameters_m.items():
        yield Finding(
            "warning",
            f"robot {name}",
            f"its discs measure {1e3 * diameter_m:.1f} mm, other than declared",
            "correct diameter_m in robots.yaml, or the lengths in wand.yaml if all robots differ",
        )


def _check_cameras(status: FusionStatus) -> Iterator[Finding]:
    if not status.cameras:
        yield Finding("error", "cameras", "none sends frames", "start roundel camera on their machines")
    for name, health in sorted(status.cameras.items()):
        problems = camera_problems(health)
        for problem in problems:
            remedy = REMEDIES.get(problem, SKIPPED).replace("NAME", name)
            yield Finding("error", f"camera {name}", problem, remedy)
        if not problems:
            residual = "" if health.residual_px is None else f", residual {health.residual_px:.2f} px"
            yield Finding("ok", f"camera {name}", f"{health.fps:.0f} frames/s{residual}")


def _check_clock(name: str, camera: CameraStatus) -> Finding:
    subject = f"clock of {name}"
    if camera.clock_offset_ms is None or camera.clock_error_ms is None:
        return Finding(
            "error", subject, "no answer from the server's clock", "check the network of that machine"
        )
    state = f"offset {camera.clock_offset_ms:z.2f} ms, known within {camera.clock_error_ms:.2f} ms"
    if camera.clock_error_ms > MAX_CLOCK_ERROR_MS:
        return Finding("warning", subject, state, "the network is slow or busy: use a cable")
    return Finding("ok", subject, state)
